"""A wrist camera whose driver states a wrong lens: errors of points as a robot computes them.

The robot takes a pixel, a depth, the exported frame and the driver's lens. Its point is compared
with the true one, over the middle of the image.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.calibration import PACKAGED, as_wrist_recording
from benchmarks.rows import Row, save
from evercal.calibration.calibration import Calibration
from evercal.geometry import SE3, Camera, cross_matrix
from evercal.geometry.rays import MIDDLE
from evercal.map import Map
from evercal.recordings import load_recording

DEPTHS_M = (0.3, 0.5, 1.0)
"""Depths of the points."""


def run(
    rooms: tuple[Path, ...] = (),
    out: Path = Path("runs/lens-answers"),
    draws: int = 1,
    centre_px: float = 5.0,
    focal_percent: float = 1.0,
) -> None:
    """Learn wrist recordings with a wrong lens, and use the exported frames with it.

    Args:
        rooms: Folders of rendered rooms. Defaults to the packaged rooms.
        out: Folder for stores and results.
        draws: Trials of each room.
        centre_px: Error of the stated principal point, in a direction of its own for each trial.
        focal_percent: Error of the stated focal lengths.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for room in rooms or PACKAGED:
        for draw in tqdm(range(draws), room.name, unit="draw"):
            recording, truth = as_wrist_recording(load_recording(room), draw)
            true = recording.train[0].camera
            angle = np.random.default_rng(draw).uniform(0, 2 * np.pi)
            stated = replace(
                true,
                fx=true.fx * (1 + focal_percent / 100),
                fy=true.fy * (1 + focal_percent / 100),
                cx=true.cx + centre_px * np.cos(angle),
                cy=true.cy + centre_px * np.sin(angle),
            )
            train = tuple(replace(frame, camera=stated) for frame in recording.train)
            store = out / f"{room.name}-{draw}.evercal"
            report = Map.open(store).learn(replace(recording, train=train))
            assert report.hand_eye is not None
            calibration = report.hand_eye.calibration
            answers = {
                "frame of the estimated lens, driver's lens": (calibration, stated),
                "exported frame, driver's lens": (calibration.for_program(), stated),
                "frame and lens as estimated": (calibration, calibration.camera),
            }
            for way, (answer, lens) in answers.items():
                for row in points(answer, lens or stated, truth, true):
                    rows.append({"room": room.name, "draw": draw, "way": way, **row})
    save(out / "lens-answers.csv", rows)
    for way in dict.fromkeys(row["way"] for row in rows):
        for depth in DEPTHS_M:
            some = [r for r in rows if (r["way"], r["depth_m"]) == (way, depth)]
            error = np.median([float(r["mm"]) for r in some])
            stated_mm = np.median([float(r["stated_mm"]) for r in some])
            print(f"{way}, {depth} m: {error:.1f} mm, stated {stated_mm:.1f} mm")


def points(
    answer: Calibration, lens: Camera, truth: SE3, true: Camera
) -> Iterator[Row]:
    """Root mean square errors of points, true and stated, millimetres."""
    across = np.linspace(*MIDDLE, 9)
    pixels = np.stack(np.meshgrid(across, across), -1).reshape(-1, 2)
    pixels = pixels * [true.width, true.height] - 0.5
    used = lens.unproject(pixels)
    left = 0.0
    if answer.lens == "stated":
        left = answer.stated_left_rad
    rotation = answer.parent_from_child.rotation_matrix()
    for depth in DEPTHS_M:
        seen = answer.parent_from_child.apply(depth * used)
        error = seen - truth.apply(depth * true.unproject(pixels))
        spread = (depth * np.linalg.norm(used, axis=1) * left) ** 2
        for i, ray in enumerate(used):
            slope = np.c_[np.eye(3), -rotation @ cross_matrix(depth * ray)]
            spread[i] += np.trace(slope @ answer.covariance @ slope.T)
        yield {
            "depth_m": depth,
            "mm": 1000 * float(np.sqrt((error**2).sum(1).mean())),
            "stated_mm": 1000 * float(np.sqrt(spread.mean())),
        }
