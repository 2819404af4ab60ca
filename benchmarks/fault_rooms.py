"""Small recordings and maps for `benchmarks.faults`."""

import json
import shutil
from pathlib import Path

import numpy as np

from evercal import Map, Recording
from evercal.recordings import write_image
from evercal.recordings.formats import generic
from evercal.recordings.frame import Frame
from evercal.simulation.box_room import BoxRoom, default_camera, look_at


def make(folder: Path) -> None:
    """Write recordings, a map of two rooms, a refreshed one, another map, images and one pose."""
    hall, yard, shed = (
        _room(seed, name) for seed, name in ((34, "hall"), (31, "yard"), (36, "shed"))
    )
    generic.write(folder / "shed", shed)
    opened = Map.open(folder / "map")
    for recording in (hall, yard):
        opened.learn(recording, memory="25%")
    Map.open(folder / "other").learn(shed, name="other", memory="25%")
    (folder / "images").mkdir()
    for frame in hall.test:
        write_image(folder / "images" / f"{frame.name}.png", np.asarray(frame.read_image()))
    shutil.copytree(folder / "map", folder / "refreshed")
    Map.open(folder / "refreshed").refresh(folder / "images")
    image = hall.test[3].read_image()
    write_image(folder / "image.png", np.asarray(image))
    pose = opened.localize(image).base_from_camera
    assert pose is not None, "the map locates its room"
    (folder / "position.json").write_text(json.dumps(pose.translation_m.tolist()))


def _room(seed: int, name: str) -> Recording:
    """Thirty training frames on a walk of half a metre, and ten test frames in between."""
    room, camera, frames = BoxRoom(seed, texture_px=256), default_camera(320, 240), []
    for i, s in enumerate(np.linspace(0, 1, 60)):
        sway, heading = np.sin(2 * np.pi * s), seed + 0.9 * s
        eye = np.array([0.5 * s - 0.25, 0.15 * sway, 1.3 + 0.1 * sway])
        ahead = np.array([np.cos(heading), np.sin(heading), 0.1 * sway - 0.1])
        pose = look_at(eye, eye + ahead, 0.1 * sway)
        frames.append(Frame(f"{name}-{i:03d}", room.render(camera, pose), camera, pose))
    return Recording(name, tuple(frames[::2]), tuple(frames[1::2][::2]))
