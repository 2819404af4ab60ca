"""Errors that the corners of an image share: a rolling shutter, a stretched print, a wrong lens.

Exact projections of a board with noise of 0.1 px, and an arm with noise of 0.1 mm and 0.02 deg.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.board_recordings import (
    BoardRecording,
    BoardSetting,
    corner_pairs,
    project,
    record,
)
from benchmarks.rows import Row, save
from evercal.calibration.boards.corners import BoardView, board_pose
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.typing import Array

SETTING = BoardSetting(arm_mm=0.1, arm_deg=0.02)
KINDS: dict[str, tuple[float, ...]] = {
    "none": (0.0,),
    "rolling shutter, px": (0.5, 1.0, 3.0),
    "motion, px": (0.5, 1.0, 3.0),
    "stretched print, %": (0.5, 1.0, 2.0, 3.0),
    "distortion left out, share": (0.25, 1.0),
    "distortion applied twice, share": (1.0,),
}
"""Kinds of errors and their sizes."""
NAMED = {
    "rolling shutter, px": "rolling shutter",
    "motion, px": "rolling shutter",
    "stretched print, %": "squares measure",
    "distortion left out, share": "distortion",
    "distortion applied twice, share": "distortion",
}
"""Words of the warning that names the cause."""


def run(draws: int = 50, out: Path = Path("runs/board-errors"), only: str = "") -> None:
    """Solve recordings of boards with each kind of error.

    Args:
        draws: Recordings of each size.
        out: Folder of the table.
        only: Kinds whose name contains it.
    """
    rows = []
    for kind, sizes in KINDS.items():
        for size in sizes:
            if only in kind:
                rows.append(_measure(kind, size, draws))
                save(out / "board-errors.csv", rows)


def _measure(kind: str, size: float, draws: int) -> Row:
    squared = []
    mm = []
    deg = []
    named = 0
    refused = 0
    for seed in tqdm(range(draws), f"{kind} {size:g}", leave=False):
        recording, pairs, corners = spoiled_pairs(kind, size, seed)
        try:
            answer = solve(pairs, recording.setting.mount, corners=corners)
        except InputError as error:
            refused += 1
            named += NAMED.get(kind, "-") in str(error)
            continue
        truth = recording.parent_from_camera
        squared.append(answer.uncertain_pose.squared_mahalanobis(truth))
        error = pose_distance_mm_deg(answer.parent_from_child, truth)
        mm.append(error[0])
        deg.append(error[1])
        warnings = " ".join(answer.checks.warnings or ())
        named += NAMED.get(kind, ": ") in warnings
    return {
        "kind": kind,
        "size": size,
        "draws": draws,
        "refused": refused,
        "median_mm": float(np.median(mm)),
        "median_deg": float(np.median(deg)),
        "mean_d2": float(np.mean(squared)),
        "largest_d2": float(np.max(squared)),
        "inside": float(np.mean(np.array(squared) < 12.59)),
        "named": named / draws,
    }


def spoiled_pairs(
    kind: str, size: float, seed: int
) -> tuple[BoardRecording, PosePairs, BoardCorners]:
    """A recording with an error, and its pose pairs with corners."""
    mounts = ("eye_in_hand", "eye_to_hand")
    setting = replace(SETTING, mount=mounts[seed % 2], views=20 + seed % 6)
    if kind.startswith("stretched"):
        setting = replace(setting, stretch=size / 100)
    recording = record(setting, seed)
    recording = _spoiled(recording, kind, size, np.random.default_rng([seed, 7]))
    return recording, *_pairs(recording, kind, size)


def _spoiled(
    recording: BoardRecording, kind: str, size: float, rng: np.random.Generator
) -> BoardRecording:
    """The recording with its corners moved."""
    views = list(recording.views)
    for i, view in enumerate(views):
        down = view.pixels[:, 1:] / recording.camera.height - 0.5
        if kind.startswith("rolling"):
            moved = view.pixels + down * rng.uniform(-size, size, 2)
        elif kind.startswith("motion"):
            moved = view.pixels + down * _motion(recording, i, size, rng)
        else:
            continue
        views[i] = BoardView(view.points_m, moved)
    return replace(recording, views=tuple(views))


def _motion(
    recording: BoardRecording, i: int, size: float, rng: np.random.Generator
) -> Array:
    """Pixels (k, 2) by which a motion of any direction moves the corners during an image."""
    twist = rng.normal(size=6) * [0.4, 0.4, 0.4, 1, 1, 1]
    pose = recording.camera_from_board[i]
    points = recording.views[i].points_m
    step = 1e-4
    there = project(points, SE3.exp(step * twist) @ pose, recording.camera)
    motion = (there - project(points, pose, recording.camera)) / step
    length = np.sqrt((motion**2).sum(1).mean())
    return motion * rng.uniform(0, size) / length


def _pairs(
    recording: BoardRecording, kind: str, size: float
) -> tuple[PosePairs, BoardCorners]:
    if not kind.startswith("distortion"):
        return corner_pairs(recording)
    factor = 1 - size
    if "twice" in kind:
        factor = 1 + size
    camera = recording.camera
    distortion = tuple(factor * value for value in camera.distortion)
    stated = replace(camera, distortion=distortion)
    poses = [board_pose(view, stated).camera_from_board for view in recording.views]
    names = tuple(f"{i}.png" for i in range(len(poses)))
    pairs = PosePairs(names, recording.base_from_gripper, SE3.stack(poses))
    corners = BoardCorners(
        stated, recording.views, stated=True, size_m=recording.setting.square_m
    )
    return pairs, corners
