"""Scores as text: tables for the terminal and for Markdown."""

import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from evercal.evaluation.metrics import SceneScores, Scores

Style = Literal["terminal", "markdown"]

# Header, field and how a number of each column is written.
_SCENE_COLUMNS: tuple[tuple[str, str, Callable[[float], str]], ...] = (
    ("5cm 5deg %", "accuracy_5cm_5deg", lambda x: _number(x, 1)),
    ("2cm 2deg %", "accuracy_2cm_2deg", lambda x: _number(x, 1)),
    ("1cm 1deg %", "accuracy_1cm_1deg", lambda x: _number(x, 1)),
    ("5mm 0.5deg %", "accuracy_5mm_05deg", lambda x: _number(x, 1)),
    ("median", "median_translation_cm", lambda x: distance(x / 100)),
    ("median deg", "median_rotation_deg", lambda x: _number(x, 2)),
    ("wrong scene %", "wrong_scene", lambda x: _number(x, 1)),
    ("unknown %", "unknown", lambda x: _number(x, 1)),
    ("in 95 % ellipsoid", "inside_95", lambda x: _number(x, 1)),
    ("near training %", "near_training_frame", lambda x: _number(x, 1)),
)
SCENE_HEADER = ("scene", "frames", *(title for title, _, _ in _SCENE_COLUMNS))
"""Titles of `scene_rows`."""


def score_table(scores: Scores, style: Style = "terminal") -> str:
    """One row per scene and, if there are several, their unweighted mean."""
    return table(SCENE_HEADER, scene_rows(scores), style)


def scene_rows(scores: Scores) -> list[list[str]]:
    """The cells of `score_table`."""
    rows = [[name, str(row.frames), *_scene_cells(row)] for name, row in scores.scenes.items()]
    if len(rows) > 1:
        means = [
            write(float(np.mean([getattr(row, field) for row in scores.scenes.values()])))
            for _, field, write in _SCENE_COLUMNS
        ]
        rows.append(["mean", "", *means])
    return rows


def distance(metres: float) -> str:
    """A length for people: in millimetres below a centimetre, else in centimetres."""
    if math.isnan(metres):
        return "-"
    millimetres = f"{1000 * metres:.2f}"
    return f"{millimetres} mm" if float(millimetres) < 10 else f"{100 * metres:.1f} cm"


def _scene_cells(row: SceneScores) -> list[str]:
    return [write(getattr(row, field)) for _, field, write in _SCENE_COLUMNS]


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
