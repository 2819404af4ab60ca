"""PnP from drawn matches with outliers: accuracy and time, beside PoseLib where it is installed."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.rows import save
from evercal.geometry import SE3, Camera
from evercal.localization import pnp
from evercal.localization.pnp import MIN_INLIERS, PnpOptions, solve_pnp
from evercal.typing import Array

_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
_OPTIONS = PnpOptions(threshold_px=8.0, progressive_sampling=True)
_FOUND_M = 0.1

Solver = Callable[[Array, Array], SE3 | None]
"""Pixels (n, 2) and points (n, 3) to points_from_camera."""


def run(out: Path = Path("results/pnp.csv"), cases: int = 60) -> None:
    """Compare solvers on the same drawn matches, the best first; one thread.

    Inliers have errors of 1.2 pixels, outliers any pixel. A case counts as right within 10 cm.
    Medians are of all cases.

    Args:
        out: File of rows to write.
        cases: Cases for each number of matches and share of outliers.
    """
    solvers: dict[str, Solver] = {
        "evercal": partial(_solved, _OPTIONS),
        "without refinement": _changed("_STEPS", 0),
        "refined by inliers": _changed("_NEAR", 1.0),
        "1000 iterations": partial(_solved, replace(_OPTIONS, max_iterations=1000)),
        "300 iterations": partial(_solved, replace(_OPTIONS, max_iterations=300)),
        "any order": partial(_solved, replace(_OPTIONS, progressive_sampling=False)),
        "OpenCV's AP3P": _opencv,
    }
    if find_spec("poselib"):
        solvers = {"PoseLib": _poselib, **solvers}
    cv2.setNumThreads(1)
    rows = []
    with threadpool_limits(1):
        for count in (60, 300):
            for outliers in (0.6, 0.8, 0.9):
                random = np.random.default_rng(1)
                drawn = [_drawn(count, outliers, random) for _ in range(cases)]
                for name, solver in solvers.items():
                    row = {"matches": count, "outliers": outliers, "solver": name}
                    rows.append(row | _measured(solver, drawn))
    save(out, rows, {"cases": cases})


def _drawn(
    count: int, outliers: float, random: np.random.Generator
) -> tuple[Array, Array, SE3]:
    truth = SE3.exp(np.array([*random.normal(0, 1, 3), *random.normal(0, 1.5, 3)]))
    size = [_CAMERA.width, _CAMERA.height]
    pixels = random.uniform(0, size, (count, 2))
    depth = random.uniform(0.8, 4, (count, 1))
    points = truth.apply(_CAMERA.unproject(pixels) * depth)
    pixels += random.normal(0, 1.2, pixels.shape)
    wrong = random.random(count) < outliers
    pixels[wrong] = random.uniform(0, size, (wrong.sum(), 2))
    # Reliable matches come first, but not all of them.
    order = np.argsort(random.normal(0, 1, count) + 2 * wrong)
    return pixels[order], points[order], truth


def _measured(
    solver: Solver, drawn: list[tuple[Array, Array, SE3]]
) -> dict[str, float]:
    solver(*drawn[0][:2])
    began = time.process_time()
    poses = [solver(pixels, points) for pixels, points, _ in drawn]
    seconds = time.process_time() - began
    errors = []
    for pose, (_, _, truth) in zip(poses, drawn, strict=True):
        shift = np.inf if pose is None else pose.translation_m - truth.translation_m
        errors.append(float(np.linalg.norm(shift)))
    return {
        "right_%": 100 * float(np.mean(np.array(errors) < _FOUND_M)),
        "median_mm": 1000 * float(np.median(errors)),
        "ms": 1000 * seconds / len(drawn),
    }


def _solved(options: PnpOptions, pixels: Array, points: Array) -> SE3 | None:
    result = solve_pnp(pixels, points, _CAMERA, options)
    return None if result is None else result.pose


def _changed(constant: str, value: float) -> Solver:
    """Our solver with another value of a constant."""

    def solver(pixels: Array, points: Array) -> SE3 | None:
        with mock.patch.object(pnp, constant, value):
            return _solved(_OPTIONS, pixels, points)

    return solver


def _opencv(pixels: Array, points: Array) -> SE3 | None:
    focal = np.diag([_CAMERA.fx, _CAMERA.fy, 1.0])
    focal[:2, 2] = _CAMERA.cx, _CAMERA.cy
    solved, turn, shift, _ = cv2.solvePnPRansac(
        points,
        pixels,
        focal,
        None,
        iterationsCount=1000,
        reprojectionError=_OPTIONS.threshold_px,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not solved:
        return None
    matrix = np.column_stack([cv2.Rodrigues(turn)[0], shift])
    return SE3.from_matrix(matrix).inverse()


def _poselib(pixels: Array, points: Array) -> SE3 | None:
    import poselib  # pyright: ignore[reportMissingImports]

    camera = {"model": "PINHOLE", "width": 0, "height": 0}
    camera["params"] = [_CAMERA.fx, _CAMERA.fy, _CAMERA.cx, _CAMERA.cy]
    ransac = {
        "max_reproj_error": _OPTIONS.threshold_px,
        "max_iterations": 1000,
        "min_iterations": 100,
        "dyn_num_trials_mult": 1.0,
        "progressive_sampling": True,
    }
    pose, info = poselib.estimate_absolute_pose(pixels, points, camera, ransac, {})
    if info["num_inliers"] < MIN_INLIERS:
        return None
    return SE3(np.asarray(pose.q), np.asarray(pose.t)).inverse()
