"""Files that say how tags lie on a thing: their corners, or their poses and sizes.

Tools differ in the order of corners, quaternions and angles, and in the axes of a tag. A file is
read in all these ways, and the images decide, see `evercal.calibration.boards.tag_layout`.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.tags import Corners, square
from evercal.recordings.poses.row_files import name_and_unit
from evercal.storage.text_files import documents, named_errors, read_text

_ID = re.compile(r"(?:tag|marker|aruco|fiducial)?_?(?:id|index|number)")
"""Names of a tag's number."""
_NUMBERED = re.compile(r"(?:tag|marker|aruco|id)?[_ -]?(\d+)")
"""Keys that are the number of a tag."""
_FIELDS = {
    "size": r"(?:default_)?(?:tag_|marker_)?(?:size|length|side|edge)",
    "corners": r"|(?:\w+_)?(?:corners?|points)|[a-z]*_?\d_?[xyz]|[xyz]_?\d",
    "rotation": r"(?:\w+_)?(?:q|quat\w*|orientation|rot\w*|rpy|euler|rvec|r)(?:_?[wxyz0-3])?"
    r"|(?:\w+_)?(?:roll|pitch|yaw)",
    "position": r"(?:\w+_)?(?:p|pos|position|translation|tvec|t(?=_?[xyz])|xyz|cent\w+)(?:_?[xyz])?"
    r"|(?:pose_)?[xyz]",
    "matrix": r"(?:\w+_)?(?:transform|matrix|pose|t)",
}
"""Names of numbers, by their meaning."""
_BESIDE = r"(?:\w+_)?(?:variance|var|noise|num_?obs|covariance|r)"
"""Names of what is no part of a layout."""
_COUNTS = {"size": (1,), "corners": (12,), "position": (3,), "rotation": (3, 4, 9)}
"""Possible numbers of numbers."""
_METRES = {"mm": 0.001, "cm": 0.01}
"""Metres of units in names."""
_HEADERS = {
    13: "id " + " ".join(f"c{k}{axis}" for k in range(4) for axis in "xyz"),
    9: "id x y z q0 q1 q2 q3 size",
    8: "id x y z q0 q1 q2 q3",
}
"""Columns of tables without a header."""
_FIDUCIALS = "id x y z roll pitch yaw variance numobs"
"""Columns of a map of fiducial_slam; numbers of other tags follow."""

_UNITS = (1.0, 0.001, 1000.0)
"""Units of positions against those of sides."""

Keys: TypeAlias = tuple[str | int, ...]
"""Keys in lower case and indices that lead to a number of a file."""
Leaves: TypeAlias = Sequence[tuple[Keys, float]]
"""All numbers of a file."""
Tag: TypeAlias = dict[str, list[float]]
"""Numbers of a tag by their meaning, see `_FIELDS`."""


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
                rows = data[0]["board"]["layout"]
                data = [
                    dict(zip(_HEADERS[13].split(), row, strict=True)) for row in rows
                ]
            leaves = [*_leaves(data, ())]
        else:
            leaves = [*_leaves(_table(text), ())]
        return _tags(leaves)


def _table(text: str) -> list[dict[str, str]]:
    lines = re.findall(r"^[^#\n]+", text, re.MULTILINE)
    rows = [re.split(r"[,;\s]+", line.strip()) for line in lines if line.strip()]
    header = rows[0] if rows else []
    if rows and re.fullmatch(r"[\d.]+", header[0]):
        counts = header[8:]
        if counts and "." in header[1] and all(cell.isdigit() for cell in counts):
            rows = [row[:9] for row in rows]
            header = _FIDUCIALS.split()
        else:
            header = _HEADERS.get(len(header), "").split()
    else:
        rows = rows[1:]
    tags = []
    for row in rows:
        if len(row) != len(header):
            raise ValueError(
                f"a row has {len(row)} cells, the header {len(header)}; give a header such as"
                " id,x,y,z,qw,qx,qy,qz,size"
            )
        tags.append(dict(zip(header, row, strict=True)))
    return tags


def _leaves(value: Any, path: Keys) -> Iterator[tuple[Keys, float]]:
    """Yield the numbers in a value."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, (*path, str(key).lower()))
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _leaves(item, (*path, k))
    elif re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", str(value).lower()):
        yield path, float(value)


def _tags(leaves: Leaves) -> dict[int, Tag]:
    places: dict[Keys, int] = {}
    for path, value in leaves:
        if "standalone_tags" in path:
            continue
        if _ID.fullmatch(str(path[-1])):
            places[path[:-1]] = int(value)
        for k, word in enumerate(path):
            match = _NUMBERED.fullmatch(word) if isinstance(word, str) else None
            if match:
                places[path[: k + 1]] = int(match[1])
    tags = {number: _tag(number, place, leaves) for place, number in places.items()}
    if not tags:
        raise ValueError(
            "holds no tags; give for each its id and corners, or id, x, y, z, a rotation and size"
        )
    if len({place[:-1] for place in places}) > 1 or len(tags) < len(places):
        raise ValueError("holds several bodies, or a tag twice; leave one of them")
    return tags


def _tag(number: int, place: Keys, leaves: Leaves) -> Tag:
    named: dict[str, list[float]] = {}
    tag: Tag = {}
    for path, value in leaves:
        words = "_".join(map(str, path[len(place) :]))
        name, unit = name_and_unit(re.sub(r"(^|_)\d+(_\d+)*$", "", words))
        if path[: len(place)] == place:
            own = named.setdefault(name, [])
            own.append(value * _METRES.get(unit or "", 1.0))
        elif path[:-1] == place[: len(path) - 1] and _meaning(path[-1]) == "size":
            tag["size"] = [value]
    for name in sorted(named, key=_order):
        own = named[name]
        meaning = _meaning(name)
        if meaning == "matrix" and len(own) in (12, 16):
            matrix = np.reshape(own, (-1, 4))[:3]
            own = [*matrix[:, 3], *matrix[:, :3].ravel()]
        if meaning == "matrix":
            tag |= {"position": own[:3], "rotation": own[3:]}
        elif meaning and len(own) < 13:
            kept = tag.get(meaning, []) if meaning != "size" else []
            tag[meaning] = kept + own
        elif not _ID.fullmatch(name) and not re.fullmatch(_BESIDE, name):
            raise ValueError(f"{name!r} of tag {number} is not known; leave it out")
    for meaning, own in tag.items():
        if len(own) not in _COUNTS[meaning]:
            raise ValueError(f"the {meaning} of tag {number} has {len(own)} numbers")
    return tag


def _meaning(name: object) -> str:
    """The meaning of a number by its name; empty if it is not known."""
    for meaning, names in _FIELDS.items():
        if re.fullmatch(names, str(name)):
            return meaning
    return ""


def _order(name: str) -> tuple[str, bool, str]:
    """Corner by corner, scalar parts first, roll before pitch, else by the alphabet."""
    digits = re.sub(r"\D", "", name)
    return digits, not re.search("(?<!a)w$", name), name.replace("roll", "a")


def layout_readings(tags: dict[int, Tag], side_m: float) -> Iterator[Corners]:
    """Yield what the tags of a file may be, metres; `side_m` is the side of those without one."""
    if all("corners" in tag for tag in tags.values()):
        for first, step in product(range(4), (1, -1)):
            order = (first + step * np.arange(4)) % 4
            yield {
                number: np.reshape(tag["corners"], (4, 3))[order]
                for number, tag in tags.items()
            }
        return
    for unit, way, axes in product(_UNITS, range(5), Rotation.create_group("O")):
        layout = {}
        for number, tag in tags.items():
            print_ = axes.apply(square(1.0)) * tag.get("size", side_m)
            turned = _rotation(tag.get("rotation", []), way).apply(print_)
            layout[number] = unit * np.array(tag.get("position", [0, 0, 0])) + turned
        yield layout


def _rotation(numbers: list[float], way: int) -> Rotation:
    """What a rotation may be."""
    if len(numbers) == 9:
        return Rotation.from_matrix(np.reshape(numbers, (3, 3)))
    if len(numbers) == 4:
        return Rotation.from_quat(numbers, scalar_first=way % 2 == 0)
    if len(numbers) == 3 and way:
        order = "xyz" if way < 3 else "XYZ"
        return Rotation.from_euler(order, numbers, degrees=way % 2 == 1)
    return Rotation.from_rotvec(numbers or [0, 0, 0])
