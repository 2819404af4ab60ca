"""Scores as text: tables for the terminal and for Markdown."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from evercal.evaluation.metrics import SceneScores, Scores

Style = Literal["terminal", "markdown"]

# Header, field and digits of each column.
_SCENE_COLUMNS = (
    ("5cm 5deg %", "accuracy_5cm_5deg", 1),
    ("1cm 1deg %", "accuracy_1cm_1deg", 1),
    ("median cm", "median_translation_cm", 1),
    ("median deg", "median_rotation_deg", 2),
    ("wrong scene %", "wrong_scene", 1),
    ("unknown %", "unknown", 1),
    ("near training %", "near_training_frame", 1),
)


def score_table(scores: Scores, style: Style = "terminal") -> str:
    """One row per scene and, if there are several, their unweighted mean."""
    header = ["scene", "frames", *(title for title, _, _ in _SCENE_COLUMNS)]
    rows = [[name, str(row.frames), *_scene_cells(row)] for name, row in scores.scenes.items()]
    if len(rows) > 1:
        means = [
            _number(float(np.mean([getattr(row, field) for row in scores.scenes.values()])), digits)
            for _, field, digits in _SCENE_COLUMNS
        ]
        rows.append(["mean", "", *means])
    return table(header, rows, style)


def _scene_cells(row: SceneScores) -> list[str]:
    return [_number(getattr(row, field), digits) for _, field, digits in _SCENE_COLUMNS]


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]], style: Style) -> str:
    """Cells as they are, the first column to the left and the others to the right."""
    from tabulate import tabulate

    if style == "markdown":
        # A bar in a scene's name would open another column.
        header = [cell.replace("|", "\\|") for cell in header]
        rows = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    return tabulate(
        rows,
        headers=header,
        tablefmt="github" if style == "markdown" else "simple",
        colalign=("left", *["right"] * (len(header) - 1)),
        disable_numparse=True,
    )
