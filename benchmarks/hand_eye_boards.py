"""Hand-eye calibration from simulated images of a board, through a lens found from the same images.

A camera with radial and tangential distortion views a chessboard; its corners have Gaussian or
heavy-tailed noise, the arm has noise of its own. Every solver gets the same corners: the lens is
calibrated from them first, as most people do.
"""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.optimize import least_squares
from tqdm import tqdm
from tyro.conf import arg

from benchmarks.board_recordings import (
    BoardRecording,
    BoardSetting,
    corner_pairs,
    pose_pairs,
    project,
    record,
)
from benchmarks.hand_eye import error
from benchmarks.rows import Row, median_of, once, save
from evercal.calibration.boards.corners import lens_vector
from evercal.calibration.boards.intrinsics import moved_camera
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.calibration.pose_pairs.solve import solve, solve_pose_pairs
from evercal.errors import InputError
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.typing import Array


def reprojection(
    recording: BoardRecording, pairs: PosePairs, corners: BoardCorners, start: SE3
) -> SE3:
    """Return parent_from_camera that minimizes all reprojection errors over X, Z and the lens.

    The arm is taken for exact, as in textbook bundle adjustment; soft L1 loss.
    """
    robot = recording.base_from_gripper
    robot = robot if recording.setting.mount == "eye_in_hand" else robot.inverse()
    board = (robot @ start @ pairs.camera_from_board)[0]
    points = recording.views[0].points_m
    pixels = np.stack([v.pixels for v in recording.views])
    lens = lens_vector(corners.camera)
    scale = np.maximum(np.abs(lens), 0.1)

    def residual(step: Array) -> Array:
        x = start @ SE3.exp(step[:6])
        z = board @ SE3.exp(step[6:12])
        camera = moved_camera(corners.camera, step[12:] * scale)
        seen = (robot @ x).inverse() @ z
        return (np.stack([project(points, p, camera) for p in seen]) - pixels).ravel()

    step = least_squares(
        residual, np.zeros(12 + len(lens)), loss="soft_l1", f_scale=0.3
    ).x
    return start @ SE3.exp(step[:6])


CORNER = BoardSetting()
POSES = BoardSetting(views=25)
CONDITIONS: dict[str, tuple[BoardSetting, bool]] = {
    "corners, clean": (CORNER, True),
    "corners, fixed camera": (replace(CORNER, mount="eye_to_hand"), True),
    "corners, 3 outliers": (replace(CORNER, outliers=3), True),
    "corners, 6 views": (replace(CORNER, views=6), True),
    "corners, 10 deg": (replace(CORNER, tilt_deg=10), True),
    "corners, heavy tails": (replace(CORNER, tails=3.0), True),
    "corners, arm 0.5 mm 0.1 deg": (replace(CORNER, arm_mm=0.5, arm_deg=0.1), True),
    "corners, square 1 % wrong": (replace(CORNER, square_error=0.01), True),
    "corners, square 5 % wrong": (replace(CORNER, square_error=0.05), True),
    "poses, clean": (POSES, False),
    "poses, fixed camera": (replace(POSES, mount="eye_to_hand"), False),
    "poses, 3 outliers": (replace(POSES, outliers=3), False),
    "poses, 6 views": (replace(POSES, views=6), False),
    "poses, 10 deg": (replace(POSES, tilt_deg=10), False),
    "poses, heavy tails": (replace(POSES, tails=3.0), False),
    "poses, depth noise 2 %": (replace(POSES, depth_noise=0.02), False),
    "poses, shared depth 0.3 %": (replace(POSES, depth_error=0.003), False),
    "poses, arm 0.5 mm 0.3 deg": (replace(POSES, arm_mm=0.5, arm_deg=0.3), False),
}
"""Setting and whether corners are given."""
BENT = BoardSetting(columns=11, rows=8, square_m=0.03, arm_mm=0.1, arm_deg=0.02)
SESSIONS = {
    f"two sessions, bend {bend:g} mm, dents {dents:g} mm": replace(
        BENT, bend_mm=bend, dents_mm=dents
    )
    for bend, dents in (
        (0, 0),
        (0.5, 0),
        (1, 0),
        (3, 0),
        (0, 0.5),
        (0, 1),
        (1, 1),
        (3, 3),
    )
}
"""Settings of two sessions of one camera before one board."""


def measure_sessions(name: str, count: int) -> Row:
    """Solve two sessions of one camera; compare their answers, and their intrinsics."""
    answers = []
    lenses = []
    squared = []
    mm = []
    refused = 0
    for seed in range(count):
        setting = replace(
            SESSIONS[name], mount=("eye_in_hand", "eye_to_hand")[seed % 2]
        )
        drawn = [record(setting, seed, session) for session in range(2)]
        try:
            fits = [
                solve_pose_pairs(p, setting.mount, corners=c)
                for p, c in map(corner_pairs, drawn)
            ]
        except InputError:
            refused += 1
            continue
        both = [fit.calibration() for fit in fits]
        truth = drawn[0].parent_from_camera
        squared += [b.uncertain_pose.squared_mahalanobis(truth) for b in both]
        mm += [pose_distance_mm_deg(b.parent_from_child, truth)[0] for b in both]
        step = error(both[0].parent_from_child, both[1].parent_from_child)
        answers.append(
            step @ np.linalg.solve(both[0].covariance + both[1].covariance, step)
        )
        change = np.diff(
            [lens_vector(fit.camera) for fit in fits if fit.camera], axis=0
        )[0]
        own = slice(12, 12 + len(change))
        spread = sum(f.fit.covariance[own, own] for f in fits)
        lenses.append(change @ np.linalg.solve(spread, change))
    row: Row = {"condition": name, "trials": count, "refused": refused}
    row |= {"median_mm": median_of(mm), "p95_mm": float(np.quantile(mm, 0.95))}
    row |= {"inside_95": share_inside(squared), "truth_d2": float(np.mean(squared))}
    return row | {
        "answers_d2": float(np.mean(answers)),
        "lens_d2": float(np.mean(lenses)),
    }


def measure(name: str, count: int, references: int) -> Row:
    """Solve many recordings of one condition; the first `references` also by other solvers."""
    setting, with_corners = CONDITIONS[name]
    squared = []
    flagged = []
    ms = []
    refused = 0
    mm = []
    reference_mm = []
    for seed in range(count):
        drawn = record(setting, seed)
        pairs, corners = (
            corner_pairs(drawn) if with_corners else (pose_pairs(drawn, seed), None)
        )
        began = time.process_time()
        try:
            result = solve(pairs, setting.mount, corners=corners)
        except InputError:
            refused += 1
            continue
        ms.append(1000 * (time.process_time() - began))
        truth = drawn.parent_from_camera
        squared.append(result.uncertain_pose.squared_mahalanobis(truth))
        flagged.append(
            any("than stated" in text for text in result.checks.to_dict()["warnings"])
        )
        mm.append(pose_distance_mm_deg(result.parent_from_child, truth)[0])
        if seed < references and corners is not None:
            estimate = reprojection(drawn, pairs, corners, result.parent_from_child)
            reference_mm.append(pose_distance_mm_deg(estimate, truth)[0])
    row: Row = {"condition": name, "trials": count, "refused": refused}
    row |= {"median_mm": median_of(mm), "p95_mm": float(np.quantile(mm, 0.95))}
    row["inside_95"] = share_inside(squared)
    row["size_flagged"] = 100 * float(np.mean(flagged))
    row["ms"] = median_of(ms)
    if reference_mm:
        row["reprojection_mm"] = median_of(reference_mm)
    return row


def run(
    count: Annotated[int, arg(name="trials")] = 300,
    references: int = 30,
    out: Path = Path("runs/handeye-boards.csv"),
) -> None:
    """Simulated boards through a distorted lens that is found from the same images.

    Rows of two sessions have squared Mahalanobis distances in the mean: of the truth and of the
    other answer (6 expected), and of the other session's intrinsics (9 expected).

    Args:
        count: Trials of each condition.
        references: Trials that are also solved by a full reprojection fit; its median is over
            these trials.
        out: File of the rows.
    """
    rows: list[Row] = []
    for name in tqdm([*CONDITIONS, *SESSIONS], unit="condition"):
        again = partial(measure_sessions, name, count)
        draw = again if name in SESSIONS else partial(measure, name, count, references)
        rows.append(once(out.with_suffix("") / f"{name}.json", draw))
    save(out, rows, {"trials": count})
