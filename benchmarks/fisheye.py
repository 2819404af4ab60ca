"""Rooms through a fisheye, beside a pinhole of as many pixels: images, fixed cameras, mounts."""

import tempfile
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.accuracy import pose_error, wrong
from benchmarks.calibration import as_wrist_recording, learned_mount
from benchmarks.rows import Row, once, save
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3, Camera
from evercal.map import Map
from evercal.recordings.frame import Frame, Recording
from evercal.simulation.box_room import BoxRoom, default_camera
from evercal.simulation.fisheye import fisheye_image

FIRST_SEED, FRAMES, TESTS, REPEATS = 40, 60, 15, 8
"""Rooms; frames of a recording; images that are located; images of one fixed camera."""
NOISE = 3.0
"""Standard deviation of the noise of an image, of 255."""


def lens(name: str) -> Camera:
    """A pinhole of 60 degrees, or an equidistant fisheye of so many."""
    if name == "pinhole":
        return default_camera()
    focal = 160 / np.deg2rad(float(name) / 2)
    return Camera(320, 240, focal, focal, 159.5, 119.5, model="fisheye")


def run(
    out: Path = Path("runs/fisheye"),
    rooms: int = 4,
    lenses: tuple[str, ...] = ("pinhole", "150", "180"),
) -> None:
    """Learn box rooms through each lens, and ask for images of every lens.

    Args:
        out: Folder of the rows; complete rooms are not repeated.
        rooms: Number of rooms.
        lenses: pinhole, or the angle that a fisheye covers along the width, degrees.
    """
    rows: list[Row] = []
    for seed in tqdm(range(FIRST_SEED, FIRST_SEED + rooms), unit="room"):
        for name in lenses:
            rows += once(out / f"{seed}-{name}.json", lambda s=seed, n=name: _room(s, n, lenses))
    save(out / "fisheye.csv", summary(rows))


def _room(seed: int, name: str, lenses: tuple[str, ...]) -> list[Row]:
    room, rows = BoxRoom(seed), []
    rng = np.random.default_rng(seed)

    def image(camera: Camera, pose: SE3) -> np.ndarray:
        if camera.model == "fisheye":
            plain = fisheye_image(camera, pose, room.render)
        else:
            plain = room.render(camera, pose)
        return np.clip(plain + rng.normal(0, NOISE, plain.shape), 0, 255).astype(np.uint8)

    camera, path, tests = lens(name), room.path(FRAMES, 1), room.path(TESTS, 2)
    frames = [Frame(f"{i:03d}", image(camera, p), camera, p) for i, p in enumerate(path)]
    recording = Recording("room", tuple(frames), ())
    with tempfile.TemporaryDirectory() as folder:
        cell = Map.open(Path(folder) / "map")
        cell.learn(recording, on_progress=lambda *_: None)
        for asked in lenses:
            for pose in tests:
                answer = cell.localize(image(lens(asked), pose), lens(asked)).uncertain_pose
                error = {} if answer is None else pose_error(answer, pose)
                rows.append({"map": name, "asked": asked, "answer": "image", **error})
        for pose in tests[::5]:
            images = [image(camera, pose) for _ in range(REPEATS)]
            answer = cell.calibrate(images, camera=camera).uncertain_pose
            rows.append(
                {"map": name, "asked": name, "answer": "fixed camera", **pose_error(answer, pose)}
            )
        wrist, truth = as_wrist_recording(recording, seed)
        error, _ = learned_mount(wrist, truth, Path(folder) / "wrist")
        rows.append({"map": name, "asked": name, "answer": "mount", **error})
    return rows


def summary(rows: list[Row]) -> list[Row]:
    """One row for each kind of answer, map and lens."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        key = str(row["answer"]), str(row["map"]), str(row["asked"])
        groups.setdefault(key, []).append(row)
    lines: list[Row] = []
    for (answer, learned, asked), group in groups.items():
        located = [row for row in group if "mm" in row]
        mm, squared = (
            np.array([float(row[key]) for row in located]) for key in ("mm", "squared_mahalanobis")
        )
        line: Row = {"answer": answer, "map": learned, "asked": asked, "number": len(group)}
        line |= {"located": len(located), "mm": float(np.median(mm))}
        line |= {"mm_90": float(np.quantile(mm, 0.9)), "inside_95": share_inside(squared)}
        lines.append(line | {"wrong": int(wrong(mm, squared).sum())})
    return lines
