"""Scores as rows of a table."""

import math

import numpy as np

from evercal.evaluation.metrics import Scores

_COLUMNS = (
    ("5cm 5deg %", "accuracy_5cm_5deg", 1, 1),
    ("2cm 2deg %", "accuracy_2cm_2deg", 1, 1),
    ("1cm 1deg %", "accuracy_1cm_1deg", 1, 1),
    ("5mm 0.5deg %", "accuracy_5mm_05deg", 1, 1),
    ("median mm", "median_translation_cm", 10, 2),
    ("median deg", "median_rotation_deg", 1, 3),
    ("wrong scene %", "wrong_scene", 1, 1),
    ("unknown %", "unknown", 1, 1),
    ("in 95 % ellipsoid", "inside_95", 1, 1),
    ("near training %", "near_training_frame", 1, 1),
)
"""Title, field of `SceneScores`, factor and number of decimals."""


def score_rows(scores: Scores) -> list[dict[str, str]]:
    """Cells by title: a row a scene and, for several scenes, their unweighted mean."""
    values = []
    rows = []
    for name, scene in scores.scenes.items():
        values.append([f * getattr(scene, field) for _, field, f, _ in _COLUMNS])
        rows.append(_row(name, str(scene.frames), values[-1]))
    if len(values) > 1:
        rows.append(_row("mean", "", np.mean(values, axis=0).tolist()))
    return rows


def _row(scene: str, frames: str, values: list[float]) -> dict[str, str]:
    cells = {"scene": scene, "frames": frames}
    for value, (title, _, _, digits) in zip(values, _COLUMNS, strict=True):
        cells[title] = "-"
        if not math.isnan(value):
            cells[title] = f"{value:.{digits}f}"
    return cells
