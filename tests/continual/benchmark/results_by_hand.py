"""Rows of results.csv by hand."""

import math
from collections.abc import Sequence

import pandas as pd

from evercal.continual.benchmark.results import scene_row
from evercal.evaluation.metrics import FrameResult

FRAMES = 20


def frame(
    scene: str, name: str, error_m: float, squared: float = math.nan
) -> FrameResult:
    """A test image with an error; infinity is a pose in another scene."""
    radians = 0.01 if math.isfinite(error_m) else math.inf
    return FrameResult(
        scene,
        name,
        error_m,
        radians,
        "ok",
        scene,
        False,
        1.0,
        50,
        0.5,
        squared_mahalanobis=squared,
    )


def row(
    strategy: str, seed: int, stage: int, scene: str, correct: int
) -> dict[str, object]:
    """`correct` of 20 frames are off by 2 cm, one is in another scene, the others by 30 cm."""
    errors = [0.02] * correct + [math.inf] + [0.3] * (FRAMES - correct - 1)
    return {
        **{"strategy": strategy, "seed": seed, "stage": stage},
        **scene_row([frame(scene, str(i), error) for i, error in enumerate(errors)]),
        **{"seconds": 10.0 + stage, "memory_bytes": 2_000_000, "head_bytes": 3_000_000},
        **{"frames_kept": 2, "environment": "1e234567"},
    }


def table(strategy: str, seed: int, rows: Sequence[Sequence[int]]) -> pd.DataFrame:
    """A run over the scenes b, a: row i has the correct frames after stage i."""
    return pd.DataFrame(
        [
            row(strategy, seed, stage, "ba"[i], correct)
            for stage, cells in enumerate(rows)
            for i, correct in enumerate(cells)
        ]
    )


OURS = pd.concat(
    [table("ours", 0, [[16], [14, 12]]), table("ours", 1, [[18], [18, 10]])]
)
THEIRS = table("theirs", 0, [[16], [4, 14]])
JOINT = pd.DataFrame([row("joint", 0, 1, scene, 18) for scene in "ba"])
