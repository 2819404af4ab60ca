"""Publishes the numbers of a measurement in `results/`, from which tables are generated."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from evercal.continual.benchmark.published import Published, Row, from_bench, write_published
from tyro.conf import Positional

from evercal.errors import InputError

FOLDER = Path(__file__).resolve().parent.parent / "results"


def run(
    source: Positional[Path], name: Positional[str], groups: tuple[str, ...] = (), note: str = ""
) -> None:
    """Write the numbers of a measurement to results/NAME.jsonl.

    Args:
        source: Folder of `evercal bench`, or rows in JSON from another measurement.
        name: Name of the file.
        groups: Rows that a table averages, each TITLE=ROW,ROW.
        note: A remark for the reader.
    """
    print(publish(source, name, groups_of(groups), note))


def publish(
    source: Path,
    name: str,
    groups: Mapping[str, tuple[str, ...]],
    note: str = "",
    out: Path = FOLDER,
) -> Path:
    """Write `OUT/NAME.jsonl`.

    Args:
        source: Folder of `evercal bench`, or a file of rows: JSON or JSON lines.
        name: Name of the file.
        groups: Rows that tables average, by title; for a file of rows.
        note: A remark for the reader.
        out: Folder to write to.

    Raises:
        InputError: Nothing to publish, or groups of missing rows.
    """
    if source.is_dir():
        return write_published(out, from_bench(source, name, note))
    settings, rows = _read(source)
    names = {str(next(iter(row.values()))) for row in rows}
    for member in (member for members in groups.values() for member in members):
        if member not in names:
            raise InputError(f"{source}: no row is called {member!r}; rows are {sorted(names)}")
    return write_published(
        out, Published(name, "rows", settings, note, groups=dict(groups), rows=tuple(rows))
    )


def groups_of(words: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Parse words `TITLE=ROW,ROW` to rows by title."""
    groups = {}
    for word in words:
        title, equals, names = word.partition("=")
        if not equals:
            raise InputError(f"--groups {word!r}: give TITLE=ROW,ROW")
        groups[title] = tuple(names.split(","))
    return groups


def _read(source: Path) -> tuple[dict[str, object], list[Row]]:
    """Read settings and rows of a file that a measurement wrote."""
    try:
        text = source.read_text()
        if source.suffix == ".jsonl":
            data: object = [json.loads(line) for line in text.splitlines()]
        else:
            data = json.loads(text)
    except (OSError, ValueError) as error:
        raise InputError(f"{source}: no rows in JSON ({error})") from None
    settings: dict[str, object] = {}
    if isinstance(data, dict):
        settings = {key: value for key, value in data.items() if key not in ("rows", "scenes")}
        settings = settings.get("settings", settings)  # pyright: ignore[reportAssignmentType]
        data = data.get("rows") or [
            {"scene": scene, **row}
            for scene, rows in data.get("scenes", {}).items()
            for row in rows
        ]
    if not isinstance(data, list) or not data or not all(isinstance(row, dict) for row in data):
        raise InputError(f"{source}: no list of rows")
    return settings, [_flat(row) for row in data]


def _flat(row: Mapping[str, object]) -> Row:
    """Flatten a row, with six digits per number; NaN and infinity become None."""
    flat: dict[str, str | float | int | bool | None] = {}
    for key, value in row.items():
        if isinstance(value, Mapping):
            flat |= _flat(value)
        elif isinstance(value, float):
            flat[key] = float(f"{value:.6g}") if math.isfinite(value) else None
        elif value is None or isinstance(value, str | int):
            flat[key] = value
        else:
            raise InputError(f"{key}: {value!r} is not a number or a word")
    return flat
