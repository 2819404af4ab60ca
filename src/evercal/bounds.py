"""Bounds on what a file or a request may hold; the variable `EVERCAL_LIMITS` changes them.

Whoever writes a file or sends a request decides how much work it makes. So sizes are checked before
the work: in headers before bodies, and before patterns, tables and decoders.
"""

import os
from dataclasses import dataclass, fields
from functools import cache

from evercal.errors import InputError

VARIABLE = "EVERCAL_LIMITS"
"""`NAME=NUMBER,...`; worker processes inherit it."""


@dataclass(frozen=True)
class Bounds:
    """Sizes above which a file is refused."""

    name_characters: int = 200
    """Name of a scene, column, joint or key."""
    cell_characters: int = 1_000
    """Cell of a table."""
    columns: int = 1_000
    """Columns of a table."""
    text_bytes: int = 100_000_000
    """Text file."""
    depth: int = 50
    """Nested lists in YAML."""
    numbers: int = 10_000_000
    """Numbers of an array, and cells of a table."""
    pixels: int = 100_000_000
    """Pixels of an image."""


def bounds() -> Bounds:
    """The bounds in force: the default ones, changed by `EVERCAL_LIMITS`."""
    return _changed(os.environ.get(VARIABLE, ""))


@cache
def _changed(changes: str) -> Bounds:
    known, values = {field.name for field in fields(Bounds)}, {}
    for change in filter(None, changes.split(",")):
        name, _, number = change.strip().partition("=")
        try:
            values[name] = int(float(number))
        except (ValueError, OverflowError):
            values = {"": 0}
        if not values.keys() <= known:
            names = ", ".join(sorted(known))
            raise InputError(f"limit {change!r}: give NAME=NUMBER, the name one of {names}")
    return Bounds(**values)


def require_at_most(count: int, name: str, what: str) -> None:
    """Raise ValueError if there is more of `what` than the bound of this name allows."""
    if count > (most := getattr(bounds(), name)):
        raise ValueError(
            f"{count:,} {what}, at most {most:,} are read; if it is right, add --limits"
            f" {name}={count}"
        )
