"""Strategies made from others: the rows of a table as a JSON file.

A file is a list of rows. Each has a `name`, the strategy that it is made `of`, `with` the fields of
its method that change, and whether it has a `map`:

    [{"name": "er_map", "of": "er", "map": true},
     {"name": "spdd_10", "of": "sars_spdd", "with": {"penalty": {"scale": 10}}},
     {"name": "sars_old_output", "of": "icarl", "with": {"selector": "sars"}}]

A penalty of another kind is told by `kind`, a class of `continual.methods.penalties`.
"""

import json
import re
from dataclasses import fields, is_dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from evercal.continual.methods import penalties
from evercal.continual.methods.penalties import Penalty
from evercal.continual.selectors import SELECTORS
from evercal.continual.strategies import Strategy, strategy_named
from evercal.errors import InputError

_KEYS = {"name", "of", "with", "map"}
_NAME = re.compile(r"\w[\w.+-]*")
"""Names become those of files."""


def load_rows(name: str) -> tuple[Strategy, ...]:
    """The rows of a file, or those of a table of the package.

    Args:
        name: path of a JSON file, or `table4`, `spdd-sweep`, `with-map`.

    Raises:
        InputError: no such file or table, or a row that makes no strategy.
    """
    return tuple(strategy_from_row(name, row) for row in read_rows(name))


def read_rows(name: str) -> list[Any]:
    """The rows of a file or table as they are written, not yet checked.

    Raises:
        InputError: no such file or table, or no list.
    """
    path = Path(name)
    if path.suffix != ".json":
        shipped = sorted(f.name.removesuffix(".json") for f in _folder().iterdir())
        if name not in shipped:
            raise InputError(f"rows {name}: give {', '.join(shipped)}, or a file .json")
        text = (_folder() / f"{name}.json").read_text(encoding="utf-8")
    elif not path.is_file():
        raise InputError(f"rows {path}: no such file")
    else:
        text = path.read_text(encoding="utf-8")
    try:
        rows = json.loads(text)
    except ValueError as error:
        raise InputError(f"rows {name}: not JSON ({error})") from None
    if not isinstance(rows, list):
        raise InputError(f"rows {name}: give a list of rows")
    return rows


def _folder():
    return files("evercal.continual.benchmark") / "row_files"


def strategy_from_row(file: str, row: object) -> Strategy:
    """The strategy of one row.

    Args:
        file: where it comes from, for errors.
        row: see above.

    Raises:
        InputError: it makes no strategy.
    """
    if not isinstance(row, dict) or not {"name", "of"} <= row.keys() <= _KEYS:
        raise InputError(f"rows {file}: a row is {row!r}; give name, of, and if need be with, map")
    name, of = str(row["name"]), strategy_named(str(row["of"]))
    if not _NAME.fullmatch(name):
        raise InputError(f"rows {file}: name {name!r}: give letters, digits and any of _.+-")
    changes, builds_map = row.get("with", {}), row.get("map", of.builds_map)
    if changes and of.method is None:
        raise InputError(f"rows {file}: {of.name} trains nothing, so there is nothing to change")
    method = of.method if of.method is None else _changed(of.method, changes, f"rows {file}")
    selector = getattr(method, "selector", None)
    if selector is not None and selector not in SELECTORS:
        known = ", ".join(SELECTORS)
        raise InputError(f"rows {file}: selector {selector!r}: unknown; use one of {known}")
    if not isinstance(builds_map, bool) or (method is None and not builds_map):
        raise InputError(
            f"rows {file}: {name}: map is {builds_map!r}; give true or false, and true where"
            " nothing is trained"
        )
    return replace(of, name=name, method=method, builds_map=builds_map)


def _changed(record: Any, changes: object, where: str) -> Any:
    """A dataclass with some fields changed, those of fields that are dataclasses too."""
    assert is_dataclass(record)
    assert not isinstance(record, type)
    if isinstance(record, Penalty) and isinstance(changes, dict) and "kind" in changes:
        record = _penalty(str(changes["kind"]), where)
        changes = {name: value for name, value in changes.items() if name != "kind"}
    kind, names = type(record).__name__, {field.name for field in fields(record)}
    if not isinstance(changes, dict) or not changes.keys() <= names:
        raise InputError(
            f"{where}: {kind} cannot change by {changes!r}; its fields are"
            f" {', '.join(sorted(names))}"
        )
    found = {}
    for name, value in changes.items():
        before = getattr(record, name)
        if is_dataclass(before):
            found[name] = _changed(before, value, where)
            continue
        if isinstance(before, float) and type(value) is int:
            value = float(value)
        if type(value) is not type(before):
            raise InputError(f"{where}: {kind}.{name} is {value!r}; give one like {before!r}")
        found[name] = value
    try:
        return replace(record, **found)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None


def _penalty(kind: str, where: str) -> Penalty:
    known = {c.__name__: c for c in vars(penalties).values() if _is_penalty(c)}
    if kind not in known:
        raise InputError(f"{where}: penalty {kind!r}: unknown; use one of {', '.join(known)}")
    return known[kind]()


def _is_penalty(thing: object) -> bool:
    return isinstance(thing, type) and issubclass(thing, Penalty) and thing is not Penalty
