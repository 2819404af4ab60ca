"""Scores as tables for the terminal and for Markdown."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from evercal.evaluation.metrics import SceneScores, Scores

Style = Literal["terminal", "markdown"]

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
SCENE_HEADER = ("scene", "frames", *(title for title, *_ in _COLUMNS))
"""Titles of `scene_rows`."""


def score_table(scores: Scores, style: Style = "terminal") -> str:
    """Format `scene_rows` as text."""
    return table(SCENE_HEADER, scene_rows(scores), style)


def scene_rows(scores: Scores) -> list[list[str]]:
    """Cells of one row a scene and, for several scenes, their unweighted mean."""
    values = np.array([_values(row) for row in scores.scenes.values()])
    rows = [
        [name, str(row.frames), *_cells(numbers)]
        for (name, row), numbers in zip(scores.scenes.items(), values, strict=True)
    ]
    return [*rows, ["mean", "", *_cells(values.mean(axis=0))]] if len(rows) > 1 else rows


def table(header: Sequence[str], rows: Sequence[Sequence[str]], style: Style) -> str:
    """Format cells as text, the first column aligned left and the others right."""
    from tabulate import tabulate

    if style == "markdown":
        header = [cell.replace("|", "\\|") for cell in header]
        rows = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    return tabulate(
        rows,
        headers=header,
        tablefmt="github" if style == "markdown" else "simple",
        colalign=("left", *["right"] * (len(header) - 1)),
        disable_numparse=True,
    )


def _values(row: SceneScores) -> list[float]:
    return [factor * getattr(row, field) for _, field, factor, _ in _COLUMNS]


def _cells(values: Sequence[float]) -> list[str]:
    return [
        "-" if math.isnan(value) else f"{value:.{digits}f}"
        for value, (*_, digits) in zip(values, _COLUMNS, strict=True)
    ]
