"""Scores as text: tables for the terminal and for Markdown."""

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from evercal.evaluation.metrics import ContinualScores, SceneScores, Scores

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
_CONTINUAL_COLUMNS = (
    ("final %", "final_accuracy"),
    ("last scene %", "last_scene_accuracy"),
    ("TFR", "total_forgetting"),
    ("forgetting", "forgetting"),
    ("BWT", "backward_transfer"),
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


def continual_table(methods: Mapping[str, ContinualScores], style: Style = "terminal") -> str:
    """One row per method."""
    header = ["method", *(title for title, _ in _CONTINUAL_COLUMNS)]
    rows = [
        [name, *(_number(getattr(row, field), 1) for _, field in _CONTINUAL_COLUMNS)]
        for name, row in methods.items()
    ]
    return table(header, rows, style)


def matrix_table(accuracies: ArrayLike, scenes: Sequence[str], style: Style = "terminal") -> str:
    """Accuracy on each scene after each stage.

    Args:
        accuracies: (stages, scenes), scenes in the order in which they were learned; what stands
            above the diagonal is left blank.
        scenes: Their names.
        style: Where it is to be read.

    Raises:
        ValueError: As many names as columns are needed.
    """
    matrix = np.asarray(accuracies, dtype=np.float64)
    if matrix.ndim != 2 or matrix.shape[1] != len(scenes) or len(matrix) > len(scenes):
        raise ValueError(
            f"accuracies are (stages, {len(scenes)}) for {len(scenes)} scenes, got {matrix.shape}"
        )
    rows = [
        [f"+ {scenes[i]}", *(_number(value, 1) if j <= i else "" for j, value in enumerate(row))]
        for i, row in enumerate(matrix)
    ]
    return table(["after", *scenes], rows, style)


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
