"""Which columns of a table, or keys of JSON, say what image or what time a row belongs to.

In any case, times with or without a unit behind them (`stamp_ns`, `time [ms]`); where there are
several, the first of the list counts. A column that holds nothing but names of image files may be
called anything. In JSON lists beside the poses stand in the plural: `images`, `stamps_s`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from evercal.recordings.images import IMAGE_ENDINGS

_NAMES = (
    "image", "image_name", "image_file", "image_path", "img", "file", "filename", "file_name",
    "file_path", "filepath", "path", "name", "frame",
)  # fmt: skip
_STAMPS = ("stamp", "timestamp", "time_stamp", "time", "t")
_UNIT = re.compile(r"[\s_]*[\s_\[(](mm|m|degrees|deg|radians|rad|ns|us|ms|s)[\])]?$|\s*\[\s*\]$")
_SHORT = {"degrees": "deg", "radians": "rad"}
_PER_SECOND = {"ms": 1e3, "us": 1e6, "ns": 1e9}
_LATEST_S = 1e11
"""The year 5138: a stamp beyond it is not in seconds."""


@dataclass(frozen=True)
class Labels:
    """Where the labels of rows stand."""

    name: int | None
    """Of the image's name."""
    stamp: int | None
    """Of the time."""
    unit: str | None
    """`s`, `ms`, `us` or `ns` of the time, if it is said."""
    all: frozenset[int]
    """Of everything that is called like a label."""


def find_labels(words: Sequence[str], plural: bool = False) -> Labels:
    """Looks for labels among the names of columns, or the keys of lists, which are in plural."""
    called: dict[str, int] = {}
    for i, word in enumerate(words):
        name, _ = name_and_unit(word)
        if not plural or name.endswith("s"):
            called.setdefault(name[:-1] if plural else name, i)
    name = next((called[n] for n in _NAMES if n in called), None)
    stamp = next((called[n] for n in _STAMPS if n in called), None)
    unit = None if stamp is None else name_and_unit(words[stamp])[1]
    known = frozenset(i for n, i in called.items() if n in _NAMES + _STAMPS)
    return Labels(name, stamp, unit, known)


def name_and_unit(cell: str) -> tuple[str, str | None]:
    """A column's plain name, and the unit behind it."""
    name = re.sub(r"^(pose|transform)[._/]", "", cell.strip().lower())
    found = _UNIT.search(name)
    unit = found.group(1) if found else None
    name = name[: found.start()] if found else name
    return re.sub(r"[\s.]+", "_", name), _SHORT.get(unit or "", unit)


def image_column(columns: Mapping[str, Sequence[object]]) -> str | None:
    """The one column that holds nothing but names of image files, whatever it is called.

    Raises:
        ValueError: There are several.
    """
    found = [name for name, cells in columns.items() if all(map(_is_image, cells))]
    if len(found) > 1:
        raise ValueError(f"{' and '.join(found)} name image files; call the right one 'image'")
    return found[0] if found else None


def _is_image(cell: object) -> bool:
    return isinstance(cell, str) and PurePath(cell).suffix.lower() in IMAGE_ENDINGS


def labels_of_lists(
    data: Mapping[str, object], count: int
) -> tuple[tuple[str, ...] | None, NDArray[np.float64] | None]:
    """Names and seconds that stand in lists of their own beside `count` poses; None without.

    Raises:
        ValueError: A list is longer or shorter, or a time is no number.
    """
    lists = {key: value for key, value in data.items() if isinstance(value, list)}
    found = find_labels([*lists], plural=True)
    names, stamps = (None if i is None else [*lists][i] for i in (found.name, found.stamp))
    names = names or image_column({key: value for key, value in lists.items() if value})
    for key in filter(None, (names, stamps)):
        if len(lists[key]) != count:
            raise ValueError(f"{key!r} holds {len(lists[key])} entries for {count} poses")
    return (
        None if names is None else tuple(map(str, lists[names])),
        None if stamps is None else seconds(number_array(lists[stamps], f"{stamps!r}"), found.unit),
    )


def number_array(values: object, what: str) -> NDArray[np.float64]:
    """An array.

    Raises:
        ValueError: Not numbers, or ragged.
    """
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{what} is made of numbers and has the same shape everywhere") from None


def seconds(stamps: NDArray[np.float64], unit: str | None) -> NDArray[np.float64]:
    """Stamps (n,) in seconds.

    Raises:
        ValueError: Numbers that cannot be seconds, and no unit that says what they are.
    """
    if unit in _PER_SECOND:
        return stamps / _PER_SECOND[unit]
    if stamps.ndim != 1 or np.abs(stamps).max(initial=0.0) > _LATEST_S:
        raise ValueError(
            f"a stamp of {np.abs(stamps).max(initial=0.0):.4g} is not in seconds; call the column"
            f" stamp_ns, stamp_us or stamp_ms"
        )
    return stamps
