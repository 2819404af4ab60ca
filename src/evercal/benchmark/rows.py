"""Strategies made from others: the rows of a table as a JSON file.

A file is a list of rows. Each has a `name`, the strategy that it is made `of`, `with` the fields of
its method that change, and whether it has a `map`:

    [{"name": "er_map", "of": "er", "map": true},
     {"name": "spdd_10", "of": "sars_spdd", "with": {"penalty": {"scale": 10}}},
     {"name": "sars_old_output", "of": "icarl", "with": {"selector": "sars"}}]

A penalty of another kind is told by `kind`, a class of `continual.methods.penalties`.
"""

import json
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


def load_rows(name: str) -> tuple[Strategy, ...]:
    """The rows of a file, or those of a table of the package.

    Args:
        name: path of a JSON file, or `table4`, `spdd-sweep`, `with-map`.

    Raises:
        InputError: no such file or table, or a row that makes no strategy.
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
    return tuple(strategy_from_row(name, row) for row in rows)


def _folder():
    return files("evercal.benchmark") / "tables"


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
    of, changes = strategy_named(str(row["of"])), row.get("with", {})
    if changes and of.method is None:
        raise InputError(f"rows {file}: {of.name} trains nothing, so there is nothing to change")
    method = of.method if of.method is None else _changed(of.method, changes, f"rows {file}")
    selector = getattr(method, "selector", None)
    if selector is not None and selector not in SELECTORS:
        known = ", ".join(SELECTORS)
        raise InputError(f"rows {file}: selector {selector!r}: unknown; use one of {known}")
    builds_map = bool(row.get("map", of.builds_map))
    return replace(of, name=str(row["name"]), method=method, builds_map=builds_map)


def _changed(record: Any, changes: object, where: str) -> Any:
    """A dataclass with some fields changed, those of fields that are dataclasses too."""
    assert is_dataclass(record)
    assert not isinstance(record, type)
    names = {field.name for field in fields(record)}
    if not isinstance(changes, dict) or not changes.keys() - {"kind"} <= names:
        raise InputError(
            f"{where}: {type(record).__name__} cannot change by {changes!r}; its fields are"
            f" {', '.join(sorted(names))}"
        )
    found = {}
    for name, value in changes.items():
        before = getattr(record, name, None)
        if name == "kind":
            continue
        if isinstance(before, Penalty) and isinstance(value, dict) and "kind" in value:
            before = _penalty(str(value["kind"]), where)
        found[name] = _changed(before, value, where) if is_dataclass(before) else value
    return replace(record, **found)


def _penalty(kind: str, where: str) -> Penalty:
    known = {c.__name__: c for c in vars(penalties).values() if _is_penalty(c)}
    if kind not in known:
        raise InputError(f"{where}: penalty {kind!r}: unknown; use one of {', '.join(known)}")
    return known[kind]()


def _is_penalty(thing: object) -> bool:
    return isinstance(thing, type) and issubclass(thing, Penalty) and thing is not Penalty
