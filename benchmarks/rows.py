"""Rows of a measurement: measured once, written as CSV, printed as a table."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import pandas as pd

from evercal.storage import write_bytes, write_json
from evercal.typing import Array

Row = dict[str, str | float]
"""A flat row of a measurement."""
Rows = TypeVar("Rows", Row, list[Row])


def save(
    out: Path,
    rows: Sequence[Mapping[str, object]],
    settings: Mapping[str, object] | None = None,
) -> None:
    """Write rows and their settings as results/ has them, and print the rows.

    Args:
        out: File NAME.csv for the rows; settings go to NAME.json beside it.
        rows: Flat rows.
        settings: What decides the numbers, as JSON values.
    """
    table = pd.DataFrame(list(rows))
    out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(out, table.to_csv(index=False, float_format="%.6g").encode())
    if settings:
        write_json(out.with_suffix(".json"), {"settings": settings})
    show(table)


def show(rows: Sequence[Mapping[str, object]] | pd.DataFrame) -> None:
    """Print rows as Markdown."""
    table = pd.DataFrame(rows).astype(object)
    table = table.where(table.notna(), None)
    print(table.to_markdown(index=False, floatfmt=".3g", missingval=""), flush=True)


def mean_row(name: str, rows: Sequence[Row]) -> Row:
    """Average the numbers of rows, ignoring NaN."""
    means = pd.DataFrame(list(rows)).mean(numeric_only=True)
    return {"scene": name, **{str(key): float(value) for key, value in means.items()}}


def grouped(rows: Sequence[Row], *keys: str) -> dict[tuple[str, ...], list[Row]]:
    """Rows by the values of some keys, in the order in which they first appear."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        values = tuple(str(row[key]) for key in keys)
        groups.setdefault(values, []).append(row)
    return groups


def numbers(rows: Sequence[Row], key: str) -> Array:
    """Values (n,) of a key in the rows that have it."""
    return np.array([float(row[key]) for row in rows if key in row])


def median_of(values: Sequence[float] | Array) -> float:
    """Median of numbers; NaN of none."""
    return float(np.median(values))


def once(path: Path, measure: Callable[[], Rows]) -> Rows:
    """Measure one or more rows and write them to a file, or read the file if it exists."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        write_bytes(path, json.dumps(measure(), indent=1).encode())
    return json.loads(path.read_text())
