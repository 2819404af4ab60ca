"""Rows of numbers from results of frames and poses, shared by the measurements."""

from collections.abc import Sequence

import numpy as np

from benchmarks.rows import Row, median_of
from evercal.evaluation.metrics import (
    COARSE,
    FINE,
    FINEST,
    MIDDLE,
    FrameResult,
    correct,
    share_inside,
)
from evercal.geometry import SE3, UncertainPose, pose_distance_mm_deg

BOUNDS = {
    "5 cm/5 deg": COARSE,
    "2 cm/2 deg": MIDDLE,
    "1 cm/1 deg": FINE,
    "0.5 cm/0.5 deg": FINEST,
}
"""Thresholds in metres and radians, by the name of their column."""

WRONG_MM = 10.0
"""Error that a wrong answer exceeds, millimetres."""
WRONG_SIGMAS = 5.0
"""Mahalanobis distance that a wrong answer exceeds as well."""


def accuracy_row(name: str, results: Sequence[FrameResult]) -> Row:
    """Summarize results of frames: accuracy, medians, refusals, ellipsoids, time.

    The share inside the 95 % ellipsoids is over all poses in the right scene, including poses with
    large errors.
    """
    flags = {
        key: np.concatenate([*correct(results, b).values()])
        for key, b in BOUNDS.items()
    }
    return {
        "scene": name,
        "frames": len(results),
        **{bound: 100 * float(of.mean()) for bound, of in flags.items()},
        "median_mm": 1000 * median_of([r.translation_error_m for r in results]),
        "median_deg": float(
            np.rad2deg(np.median([r.rotation_error_rad for r in results]))
        ),
        "wrong_scene": sum(r.wrong_scene for r in results),
        "refused": sum(r.status != "ok" for r in results),
        "inside_95": share_inside([r.squared_mahalanobis for r in results]),
        "ms": median_of([r.milliseconds for r in results]),
    }


def pose_error(estimate: UncertainPose, truth: SE3) -> Row:
    """Return the error of a pose, its standard deviation per axis, and its Mahalanobis distance."""
    mm, deg = pose_distance_mm_deg(estimate.pose, truth)
    return {
        "mm": mm,
        "deg": deg,
        "sigma_mm": estimate.sigma_mm,
        "sigma_deg": estimate.sigma_deg,
        "squared_mahalanobis": estimate.squared_mahalanobis(truth),
    }


def wrong(mm: np.ndarray, squared_mahalanobis: np.ndarray) -> np.ndarray:
    """Return which answers (n,) are wrong; NaN is not, infinity is."""
    return (mm > WRONG_MM) & (squared_mahalanobis > WRONG_SIGMAS**2)
