"""Classes of fields that do not change, and how their objects look in a notebook."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from typing import TypeVar, dataclass_transform

Class = TypeVar("Class")


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(fields: type[Class]) -> type[Class]:
    """A class whose objects are equal if their fields are."""
    return dataclass(frozen=True)(fields)


@dataclass_transform(eq_default=False, frozen_default=True, field_specifiers=(field,))
def frozen_arrays(fields: type[Class]) -> type[Class]:
    """A class that holds arrays, so that an object is equal only to itself."""
    return dataclass(frozen=True, eq=False)(fields)


def html_table(title: str, rows: Mapping[str, object]) -> str:
    """A table of names and values below a title; all text is escaped."""
    lines = [f"<table><caption>{escape(title)}</caption>"]
    for name, value in rows.items():
        cells = f"<th>{escape(name)}</th><td>{escape(str(value))}</td>"
        lines.append(f"<tr>{cells}</tr>")
    return "".join([*lines, "</table>"])
