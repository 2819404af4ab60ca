"""Puts the numbers of a measurement into `results/`, from where tables are made."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from evercal.continual.benchmark.published import Published, Row, from_bench, write_published
from evercal.errors import InputError

FOLDER = Path(__file__).resolve().parent.parent / "results"


def publish(
    source: Path,
    name: str,
    groups: Mapping[str, tuple[str, ...]],
    note: str = "",
    out: Path = FOLDER,
) -> Path:
    """Writes `OUT/NAME.jsonl`.

    Args:
        source: folder of `evercal bench`, or a file of rows: JSON or JSON lines.
        name: of the table.
        groups: rows that tables take together, by title; for a file of rows.
        note: what a reader must know besides.
        out: the folder.

    Raises:
        InputError: nothing that can be published, or groups of rows that are not there.
    """
    if source.is_dir():
        return write_published(out, from_bench(source, name, note))
    settings, rows = _read(source)
    known = {str(next(iter(row.values()))) for row in rows}
    missing = [one for of in groups.values() for one in of if one not in known]
    if missing:
        raise InputError(f"{source}: no row is called {missing[0]!r}; there are {sorted(known)}")
    return write_published(
        out, Published(name, "rows", settings, note, groups=dict(groups), rows=tuple(rows))
    )


def groups_of(words: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """`TITLE=ROW,ROW` to rows by title."""
    found = {}
    for word in words:
        title, equals, names = word.partition("=")
        if not equals:
            raise InputError(f"--groups {word!r}: give TITLE=ROW,ROW")
        found[title] = tuple(names.split(","))
    return found


def _read(source: Path) -> tuple[dict[str, object], list[Row]]:
    """Settings and rows of a file, as `maps`, `calibration` and `peers` write them."""
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
            {"scene": scene, **row} for scene, of in data.get("scenes", {}).items() for row in of
        ]
    if not isinstance(data, list) or not data or not all(isinstance(row, dict) for row in data):
        raise InputError(f"{source}: holds no list of rows")
    return settings, [_flat(row) for row in data]


def _flat(row: Mapping[str, object]) -> Row:
    """Six digits are more than any of it is good for."""
    found: dict[str, str | float | int | bool | None] = {}
    for key, value in row.items():
        if isinstance(value, Mapping):
            found |= _flat(value)
        elif isinstance(value, float):
            number = float(f"{value:.6g}")
            found[key] = number if abs(number) < float("inf") else None  # NaN fails this too
        elif value is None or isinstance(value, str | int):
            found[key] = value
        else:
            raise InputError(f"{key}: {value!r} is not a number or a word")
    return found
