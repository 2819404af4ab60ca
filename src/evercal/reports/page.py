"""HTML reports from templates: one self-contained file each, readable offline."""

import base64
import functools
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from evercal.classes import frozen_arrays
from evercal.errors import with_options
from evercal.recordings.images import encode_jpeg
from evercal.recordings.poses.row_files import is_number
from evercal.reports.charts import INKS
from evercal.typing import Image

if TYPE_CHECKING:
    from jinja2 import Environment

_TEMPLATES = Path(__file__).parent / "templates"


class Picture(NamedTuple):
    """A photograph."""

    image: Image
    """(h, w, 3) RGB."""
    caption: str = ""
    """Text below the picture, also its alternative text."""

    @property
    def uri(self) -> str:
        """A JPEG file as a data URI."""
        data = base64.b64encode(encode_jpeg(self.image, quality=88))
        return f"data:image/jpeg;base64,{data.decode()}"


@frozen_arrays
class Table:
    """A table. Columns of numbers are aligned right, columns without any value are hidden."""

    header: Sequence[str]
    """Column titles."""
    rows: Sequence[Sequence[str | int | float]]
    """Cells. Numbers are written by `str`, so round them first."""
    caption: str = ""
    """Title of the table."""

    @classmethod
    def of_records(cls, records: Sequence[Any]) -> Self:
        """One row for each dataclass record, one column for each field."""
        header = [field.name.replace("_", " ") for field in fields(records[0])]
        rows = []
        for record in records:
            rows.append([_cell(name, value) for name, value in vars(record).items()])
        return cls(header, rows)

    @property
    def columns(self) -> list[int]:
        """Indices of the columns to show."""
        everything = list(range(len(self.header)))
        if not self.rows:
            return everything
        return [i for i in everything if not all(map(_blank, self._column(i)))]

    @property
    def numeric(self) -> set[int]:
        """Indices of the columns that hold only numbers and blanks."""
        if not self.rows:
            return set()
        return {i for i in self.columns if all(map(_number, self._column(i)))}

    def _column(self, index: int) -> list[str | int | float]:
        return [row[index] for row in self.rows]


class Tile(NamedTuple):
    """A number that comes first, and what it measures."""

    number: str
    """With its unit."""
    meaning: str
    """Definition of the measure."""


def render(template: str, **values: object) -> str:
    """Fill in a template, escaping all values; the document refers to no other file."""
    return environment().get_template(template).render(values, inks=INKS)


@functools.cache
def environment() -> "Environment":
    """The templates; undefined names raise. Filter `options`: see `with_options`."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    templates = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters["options"] = lambda value: with_options(str(value))
    return templates


def _cell(name: str, value: object) -> str:
    if isinstance(value, float):
        digits = 2 + name.endswith("_deg")
        return f"{value:.{digits}f}"
    words = {None: "-", True: "yes", False: "no"}
    if value is None or isinstance(value, bool):
        return words[value]
    return str(value)


def _blank(cell: str | int | float) -> bool:
    return str(cell).strip() in ("", "-")


def _number(cell: str | int | float) -> bool:
    return _blank(cell) or is_number(str(cell).removesuffix("%").partition("±")[0])
