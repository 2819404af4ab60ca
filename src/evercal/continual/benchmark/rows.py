"""Strategies derived from others: the rows of a comparison as a JSON file.

A file is a list of rows. Each has a `name`, the strategy it is derived from (`of`), changed fields
of its method (`with`), and whether it builds a `map`:

    [{"name": "er_map", "of": "er", "map": true},
     {"name": "spdd_10", "of": "sars_spdd", "with": {"penalty": {"scale": 10}}},
     {"name": "sars_old_output", "of": "icarl", "with": {"selector": "sars"}}]

`kind` selects another penalty, a class of `continual.methods.penalties`.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from evercal.continual.methods import penalties
from evercal.continual.methods.penalties import Penalty
from evercal.continual.selection.selectors import SELECTORS
from evercal.continual.strategies import Strategy, strategy_named
from evercal.errors import InputError

_KEYS = {"name", "of", "with", "map"}
_NAME = re.compile(r"\w[\w.+-]*")  # names become file names
_PENALTIES = {
    name: kind
    for name, kind in vars(penalties).items()
    if isinstance(kind, type) and issubclass(kind, Penalty) and kind is not Penalty
}


def load_rows(name: str) -> tuple[Strategy, ...]:
    """Load the strategies of a file or of a packaged table.

    Args:
        name: Path of a JSON file, or `table4`, `spdd-sweep`, `with-map`.

    Raises:
        InputError: No such file or table, or an invalid row.
    """
    return tuple(strategy_from_row(name, row) for row in read_rows(name))


def read_rows(name: str) -> list[Any]:
    """Read the rows of a file or packaged table without checking them.

    Raises:
        InputError: No such file or table, or not a list.
    """
    path, tables = Path(name), files("evercal.continual.benchmark") / "row_files"
    if path.suffix == ".json":
        if not path.is_file():
            raise InputError(f"rows {path}: no such file")
        text = path.read_text(encoding="utf-8")
    else:
        packaged = sorted(file.name.removesuffix(".json") for file in tables.iterdir())
        if name not in packaged:
            raise InputError(f"rows {name}: give {', '.join(packaged)}, or a file .json")
        text = (tables / f"{name}.json").read_text(encoding="utf-8")
    try:
        rows = json.loads(text)
    except ValueError as error:
        raise InputError(f"rows {name}: not JSON ({error})") from None
    if not isinstance(rows, list):
        raise InputError(f"rows {name}: give a list of rows")
    return rows


def strategy_from_row(file: str, row: object) -> Strategy:
    """Derive the strategy of one row.

    Args:
        file: Source of the row, for messages.
        row: See the top of this file.

    Raises:
        InputError: The row is invalid.
    """
    where = f"rows {file}"
    if not isinstance(row, dict) or not {"name", "of"} <= row.keys() <= _KEYS:
        raise InputError(f"{where}: row {row!r}; give name and of, optionally with and map")
    name, parent = str(row["name"]), strategy_named(str(row["of"]))
    if not _NAME.fullmatch(name):
        raise InputError(f"{where}: name {name!r}: give letters, digits and any of _.+-")
    changes, builds_map = row.get("with", {}), row.get("map", parent.builds_map)
    if changes and parent.method is None:
        raise InputError(f"{where}: {parent.name} trains nothing; omit with")
    method = None if parent.method is None else _changed(parent.method, changes, where)
    selector = getattr(method, "selector", None)
    if selector is not None and selector not in SELECTORS:
        names = ", ".join(SELECTORS)
        raise InputError(f"{where}: selector {selector!r}: unknown; use one of {names}")
    if not isinstance(builds_map, bool) or (method is None and not builds_map):
        raise InputError(
            f"{where}: {name}: map is {builds_map!r}; give true or false (true if nothing is"
            " trained)"
        )
    return replace(parent, name=name, method=method, builds_map=builds_map)


def _changed(record: Any, changes: object, where: str) -> Any:
    """Replace fields of a dataclass, recursively."""
    if isinstance(record, Penalty) and isinstance(changes, Mapping) and "kind" in changes:
        kind = str(changes["kind"])
        if kind not in _PENALTIES:
            names = ", ".join(_PENALTIES)
            raise InputError(f"{where}: penalty {kind!r}: unknown; use one of {names}")
        record = _PENALTIES[kind]()
        changes = {name: value for name, value in changes.items() if name != "kind"}
    kind, names = type(record).__name__, {item.name for item in fields(record)}
    if not isinstance(changes, Mapping) or not changes.keys() <= names:
        allowed = ", ".join(sorted(names))
        raise InputError(f"{where}: {kind} has no fields {changes!r}; its fields are {allowed}")
    values = {}
    for name, value in changes.items():
        before = getattr(record, name)
        if is_dataclass(before):
            value = _changed(before, value, where)
        elif isinstance(before, float) and type(value) is int:
            value = float(value)
        elif type(value) is not type(before):
            raise InputError(f"{where}: {kind}.{name} is {value!r}; give one like {before!r}")
        values[name] = value
    try:
        return replace(record, **values)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None
