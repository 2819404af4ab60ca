"""Simulated recordings of a robot cell.

OUT/wrist/                    a recording of the camera on the gripper, see `live.recorder`.
OUT/tripod/0000.jpg, ...      images of the fixed camera while the arm moves.
OUT/held/                     the fixed camera while the gripper turns a box.
OUT/reachable.csv             gripper poses that the arm can reach, for further views.
OUT/rough.txt                 gripper_from_camera as in the drawing of the cell, 4x4.
OUT/truth.json                true gripper_from_camera and base_from_tripod, and all settings.
"""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from evercal.errors import InputError
from evercal.geometry import SE3, pose_to_dict
from evercal.live.recorder import JPEG_QUALITY, WristRecorder, pose_rows
from evercal.mapping.selection import spread_poses
from evercal.recordings.images import write_jpeg
from evercal.simulation.virtual_cell import (
    CellOptions,
    VirtualCamera,
    VirtualCell,
    nominal_mount,
)
from evercal.storage import write_bytes, write_json

WRIST_IMAGES = 25
"""Images of the camera on the gripper, by default."""
TRIPOD_IMAGES = 8
"""Images of the fixed camera while the arm moves."""
HELD_IMAGES = 25
"""Images of the fixed camera while the gripper turns a box."""
REACHABLE = 200
"""Gripper poses in reachable.csv, from which those of the recordings are chosen."""


def record_cell(
    out: Path,
    seed: int = 0,
    wrist_images: int = WRIST_IMAGES,
    options: CellOptions | None = None,
) -> Iterator[None]:
    """Record a virtual cell into a new folder; yields after each image.

    Poses of recordings are spread over the reachable ones. No other command reads the truth.
    """
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out}: is not empty; give a new folder")
    if wrist_images < 1:
        raise InputError(f"frames {wrist_images}: at least 1")
    cell = VirtualCell(seed, options)
    out.mkdir(parents=True, exist_ok=True)
    reachable = cell.reachable_poses(REACHABLE)
    views = cell.reachable_poses(max(20 * wrist_images, REACHABLE), seed=1)
    camera = cell.wrist_camera
    yield from _record(cell, camera, views, wrist_images, out / "wrist")
    for i in range(TRIPOD_IMAGES):
        cell.robot.move_to(reachable[i])
        _, image = cell.tripod_camera.read()
        write_jpeg(out / f"tripod/{i:04d}.jpg", image, JPEG_QUALITY)
        yield
    cell.hold(True)
    views = cell.holding_poses(REACHABLE)
    camera = cell.tripod_camera
    yield from _record(cell, camera, views, HELD_IMAGES, out / "held")
    write_bytes(out / "reachable.csv", pose_rows(reachable).encode())
    number = "{:.9g}".format
    rows = [" ".join(map(number, row)) + "\n" for row in nominal_mount().matrix()]
    write_bytes(out / "rough.txt", "".join(rows).encode())
    truth = {
        "gripper_from_camera": pose_to_dict(cell.truth.gripper_from_camera),
        "base_from_tripod": pose_to_dict(cell.truth.base_from_tripod),
        "seed": seed,
        "options": asdict(cell.options),
    }
    write_json(out / "truth.json", truth)


def _record(
    cell: VirtualCell,
    camera: VirtualCamera,
    views: SE3,
    images: int,
    out: Path,
) -> Iterator[None]:
    """Record images of a camera at gripper poses that are spread over `views` (n,)."""
    recorder = WristRecorder(out, cell.intrinsics)
    for i in spread_poses(views, images):
        cell.robot.move_to(views[i])
        _, image = camera.read()
        recorder.add(image, cell.robot.base_from_gripper())
        yield
