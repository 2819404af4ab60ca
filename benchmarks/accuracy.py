"""Rows of numbers from results of frames, shared by the measurements."""

from collections.abc import Sequence

import numpy as np

from evercal.evaluation.metrics import (
    COARSE,
    FINE,
    FINEST,
    MIDDLE,
    FrameResult,
    correct,
    share_inside,
)

BOUNDS = {"5 cm/5 deg": COARSE, "2 cm/2 deg": MIDDLE, "1 cm/1 deg": FINE, "0.5 cm/0.5 deg": FINEST}
"""Thresholds in metres and radians, by the name of their column."""

Row = dict[str, str | float]
"""A flat row of a measurement."""


def accuracy_row(name: str, results: Sequence[FrameResult]) -> Row:
    """Summarize results of frames: accuracy, medians, refusals, ellipsoids, time.

    The share inside the 95 % ellipsoids is over all poses in the right scene, including poses with
    large errors.
    """
    flags = {key: np.concatenate([*correct(results, b).values()]) for key, b in BOUNDS.items()}
    return {
        "scene": name,
        "frames": len(results),
        **{bound: 100 * float(of.mean()) for bound, of in flags.items()},
        "median_mm": 1000 * float(np.median([r.translation_error_m for r in results])),
        "median_deg": float(np.rad2deg(np.median([r.rotation_error_rad for r in results]))),
        "wrong_scene": sum(r.wrong_scene for r in results),
        "refused": sum(r.status != "ok" for r in results),
        "inside_95": share_inside([r.squared_mahalanobis for r in results]),
        "ms": float(np.median([r.milliseconds for r in results])),
    }


def mean_row(name: str, rows: Sequence[Row]) -> Row:
    """Average the numbers of rows, ignoring NaN."""
    import pandas

    means = pandas.DataFrame(list(rows)).mean(numeric_only=True)
    return {"scene": name, **{str(key): float(value) for key, value in means.items()}}
