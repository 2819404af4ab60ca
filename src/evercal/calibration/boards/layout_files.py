"""Files that say how tags lie on a thing: their corners, or their poses and sizes.

Tools differ in the order of corners, quaternions and angles, and in the axes of a tag. A file is
read in all these ways, and the images decide, see `evercal.calibration.boards.tag_layout`.
"""

import re
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.tags import Corners, square
from evercal.recordings.poses.row_files import is_number, name_and_unit, table_cells
from evercal.storage.text_files import documents, named_errors, read_text
from evercal.typing import JsonObject

_ID = re.compile(r"(?:tag|marker|aruco|fiducial)?_?(?:id|index|number)")
"""Names of a tag's number."""
_NUMBERED = re.compile(r"(?:tag|marker|aruco|id)?[_ -]?(\d+)")
"""Keys that are the number of a tag."""
_MEANINGS = {
    "beside": "id index number variance var noise covariance num obs",
    "size": "size length side edge width",
    "corners": "corner corners point points",
    "rotation": "rotation quaternion orientation quat rot q qw qx qy qz rvec rx ry rz rpy euler"
    " roll pitch yaw",
    "position": "position translation pos p tvec tx ty tz center centre xyz x y z",
    "pose": "pose transform matrix t",
}
"""Words in the names of numbers, by their meaning; the first meaning counts."""
_COUNTS = {"size": (1,), "corners": (12,), "position": (3,), "rotation": (3, 4, 9)}
"""Possible numbers of numbers."""
_METRES = {"mm": 0.001, "cm": 0.01}
"""Metres of units in names."""
_HEADERS = {
    13: "id x0 y0 z0 x1 y1 z1 x2 y2 z2 x3 y3 z3",
    9: "id x y z q0 q1 q2 q3 size",
    8: "id x y z q0 q1 q2 q3",
}
"""Columns of tables without a header."""
_UNITS = (1.0, 0.001, 1000.0)
"""Units of positions against those of sides."""
_ANGLES = tuple(product(("xyz", "XYZ", "zyx", "ZYX"), (True, False)))
"""Orders of angles, and whether they are in degrees."""

Tag: TypeAlias = dict[str, list[float]]
"""Numbers of a tag by their meaning, see `_MEANINGS`."""


def read_tags(path: Path) -> dict[int, Tag]:
    """Read the tags of a file, by their numbers."""
    with named_errors(path, "layout of tags"):
        text = read_text(path, "layout of tags")
        if path.suffix.lower() in (".json", ".yaml", ".yml"):
            # OpenCV before 3.4.1 wrote no space behind a colon.
            text = re.sub(r"(\w):(?=[-\d\[{])", r"\1: ", text)
            data = documents(text, path.suffix == ".json")
            if isinstance(data[0], Mapping) and "camera_from" in data[0]:
                # A file of board poses.
                data = _named(data[0]["board"]["layout"])
        else:
            lines = [line for line in text.splitlines() if line[:1] != "#"]
            data = _named(table_cells(lines).tolist())
        bodies = [*_bodies(data)]
        if len(bodies) != 1:
            raise ValueError(
                f"holds {len(bodies)} things with tags, not one; give for each tag its id and"
                " corners, or id, x, y, z, a rotation and size"
            )
        return bodies[0]


def _named(rows: list[list[object]]) -> list[JsonObject]:
    """Rows of a table with the names of their columns."""
    width = len(rows[0]) if rows else 0
    header = _HEADERS.get(width, "").split()
    if rows and not is_number(rows[0][0]):
        header = [str(word) for word in rows[0]]
        rows = rows[1:]
    if len(header) != width:
        raise ValueError(
            f"has {width} columns without names; give a header such as"
            " id,x,y,z,qw,qx,qy,qz,size"
        )
    return [dict(zip(header, row, strict=True)) for row in rows]


def _bodies(value: Any) -> Iterator[dict[int, Tag]]:
    """Yield the tags of each list of tags, by their numbers."""
    items = value.items() if isinstance(value, Mapping) else []
    if isinstance(value, list):
        items = [("", item) for item in value]
    tags: dict[int, Tag] = {}
    for key, item in items:
        number = _number(str(key).lower(), item)
        if number in tags:
            raise ValueError(f"holds tag {number} twice")
        if number is not None:
            tags[number] = _tag(number, item)
        elif key != "standalone_tags":
            yield from _bodies(item)
    if tags:
        yield tags


def _number(key: str, item: object) -> int | None:
    """The number of a tag; None for another entry of a file."""
    match = _NUMBERED.fullmatch(key)
    if match and isinstance(item, (list, Mapping)):
        return int(match[1])
    if isinstance(item, Mapping):
        for name, value in item.items():
            if _ID.fullmatch(str(name).lower()):
                if str(value).isdigit():
                    return int(value)
                raise ValueError(f"the number of a tag is whole, got {value!r}")
    return None


def _tag(number: int, item: object) -> Tag:
    tag: Tag = {}
    for name, value in _leaves(item, "" if isinstance(item, Mapping) else "corners"):
        plain, unit = name_and_unit(name.strip("_"))
        words = re.findall("[a-z]+", plain)
        for meaning, known in _MEANINGS.items():
            if not {*words}.isdisjoint(known.split()):
                values = tag.setdefault(meaning, [])
                values.append(value * _METRES.get(unit or "", 1.0))
                break
        else:
            raise ValueError(f"{plain!r} of tag {number} is not known; leave it out")
    tag.pop("beside", None)
    pose = tag.pop("pose", [])
    if len(pose) in (12, 16):
        matrix = np.reshape(pose, (-1, 4))[:3]
        pose = [*matrix[:, 3], *matrix[:, :3].ravel()]
    if pose:
        tag |= {"position": pose[:3], "rotation": pose[3:]}
    if len(tag.get("position", [])) == 12:
        tag["corners"] = tag.pop("position")
    for meaning, values in tag.items():
        if len(values) not in _COUNTS[meaning]:
            raise ValueError(f"the {meaning} of tag {number} has {len(values)} numbers")
    return tag


def _leaves(value: Any, name: str) -> Iterator[tuple[str, float]]:
    """Yield the numbers in a value, with the keys that lead to them."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, f"{name}_{key}")
    elif isinstance(value, list):
        for item in value:
            yield from _leaves(item, name)
    elif is_number(value) and np.isfinite(float(value)):
        yield name, float(value)


def layout_readings(tags: dict[int, Tag], side_m: float) -> Iterator[Corners]:
    """Yield what the tags of a file may be, metres; `side_m` is the side of those without one."""
    corners = {number: tag.get("corners", []) for number, tag in tags.items()}
    if all(corners.values()):
        for first, step in product(range(4), (1, -1)):
            order = (first + step * np.arange(4)) % 4
            yield {
                number: np.reshape(own, (4, 3))[order]
                for number, own in corners.items()
            }
        return
    turns = {k: _rotations(tag.get("rotation")) for k, tag in tags.items()}
    ways = range(min(map(len, turns.values())))
    for unit, way, axes in product(_UNITS, ways, Rotation.create_group("O")):
        printed = axes.apply(square(1.0))
        layout = {}
        for number, tag in tags.items():
            middle = unit * np.array(tag.get("position", [0, 0, 0]))
            arms = turns[number][way].apply(printed)
            layout[number] = middle + tag.get("size", side_m) * arms
        yield layout


def _rotations(numbers: list[float] | None) -> list[Rotation]:
    """What a rotation may be."""
    if not numbers:
        return [Rotation.identity()]
    if len(numbers) == 9:
        return [Rotation.from_matrix(np.reshape(numbers, (3, 3)))]
    if len(numbers) == 4:
        return [Rotation.from_quat(numbers, scalar_first=way) for way in (True, False)]
    angles = [Rotation.from_euler(way, numbers, degrees=deg) for way, deg in _ANGLES]
    return [Rotation.from_rotvec(numbers), *angles]
