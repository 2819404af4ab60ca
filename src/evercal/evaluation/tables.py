"""Scores as rows of a table."""

import math

import numpy as np

from evercal.evaluation.metrics import Scores

# Title, field of SceneScores, factor and number of decimals.
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


def score_rows(scores: Scores) -> list[dict[str, str]]:
    """Cells by title: a row a scene and, for several scenes, their unweighted mean."""
    values = [
        [f * getattr(row, name) for _, name, f, _ in _COLUMNS]
        for row in scores.scenes.values()
    ]
    heads = [(name, str(row.frames)) for name, row in scores.scenes.items()]
    if len(values) > 1:
        values.append(np.mean(values, axis=0).tolist())
        heads.append(("mean", ""))
    return [
        {"scene": scene, "frames": frames}
        | {
            title: _cell(value, digits)
            for value, (title, _, _, digits) in zip(row, _COLUMNS, strict=True)
        }
        for (scene, frames), row in zip(heads, values, strict=True)
    ]


def _cell(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
