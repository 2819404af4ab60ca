"""Links, joints and geometry of a URDF, by one strict reading of its XML."""

from collections.abc import Mapping
from difflib import get_close_matches
from typing import NamedTuple
from xml.parsers import expat

import numpy as np

from evercal.bounds import require_at_most
from evercal.classes import frozen_arrays
from evercal.storage.text_files import naming
from evercal.typing import Strings

_ENDS = (
    "name",
    "type",
    "parent link",
    "child link",
)
_MOST = 1e6
"""No number of an arm is so large."""
_DEFAULTS = {
    "origin xyz": "0 0 0",
    "origin rpy": "0 0 0",
    "axis xyz": "1 0 0",
    "mimic multiplier": "1",
    "mimic offset": "0",
    "limit lower": "-inf",
    "limit upper": "inf",
}
"""Numbers of a joint, and what they are if they are omitted."""
_PARTS = {"parent", "child", "origin", "axis", "mimic", "limit"}
"""Elements of a joint that count."""
_SIZES = {
    "mesh": {"mesh scale": 3},
    "box": {"box size": 3},
    "cylinder": {"cylinder radius": 1, "cylinder length": 1},
    "sphere": {"sphere radius": 1},
}
"""Numbers of each shape."""
_KNOWN = {
    *_ENDS,
    *_DEFAULTS,
    "mimic joint",
}


class Element(NamedTuple):
    """A link, its geometry, or a joint as the file states it."""

    tag: str
    stated: dict[str, str]
    """Its attributes, and those of elements in it by two names, such as `axis xyz`."""
    starts: dict[str, int]
    """Bytes of the file at which it and the elements in it begin; the first of each name counts."""


@frozen_arrays
class Joint:
    """A joint."""

    name: str
    type: str
    parent: str
    child: str
    numbers: Mapping[str, list[float]]
    """By element and attribute, such as `axis xyz`."""
    element: Element

    def problem(self) -> str:
        """What makes its pose doubtful; empty if nothing does."""
        stated = self.element.stated
        if "origin quat_xyzw" in stated:
            # Of the readers, pinocchio alone heeds it.
            return "is turned by quat_xyzw, which most programs ignore; write rpy"
        missing = _KNOWN - stated.keys()
        if self.type == "fixed":
            missing &= {
                "origin xyz",
                "origin rpy",
            }
        for name in sorted(stated.keys() - _KNOWN):
            for like in get_close_matches(name.lower(), missing, 1, 0.8):
                return f"has '{name}'; did you mean '{like}'?"
        return ""


class Geometry(NamedTuple):
    """A visual or collision element of a link."""

    link: str
    kind: str
    """visual or collision."""
    shape: str
    """mesh, box, cylinder or sphere; empty if none of them is stated."""
    file: str
    """File of a mesh."""
    sizes: list[float]
    """Scale of a mesh, size of a box, radius and length of a cylinder, or radius of a sphere."""
    xyz: list[float]
    rpy: list[float]
    """Its origin in the link."""


def parsed_urdf(data: bytes) -> tuple[Strings, tuple[Joint, ...]]:
    """Names of links, and the joints, in the order of the file; all else is skipped.

    Raises:
        ValueError: It is no XML, or one of them is incomplete.
    """
    links = []
    joints = []
    for element in _elements(data):
        if element.tag in ("visual", "collision"):
            continue
        with naming(f"{element.tag} {element.stated.get('name')}"):
            try:
                if element.tag == "joint":
                    joints.append(_joint(element))
                else:
                    links.append(element.stated["name"])
            except KeyError as missing:
                raise ValueError(f"its {missing} is missing") from None
    if not links:
        raise ValueError("it has no links; make a URDF of a macro file with xacro")
    return tuple(links), tuple(joints)


def stated_geometry(data: bytes) -> list[Geometry]:
    """Visual and collision geometry of all links, in the order of the file.

    Raises:
        ValueError: A number of it is missing or wrong.
    """
    found = []
    for element in _elements(data):
        if element.tag in ("visual", "collision"):
            link = element.stated["link"]
            with naming(f"{element.tag} of link {link}"):
                found.append(_geometry(link, element))
    return found


def _geometry(link: str, element: Element) -> Geometry:
    stated = {"mesh scale": "1 1 1", **element.stated}
    shapes = [shape for shape in _SIZES if shape in element.starts]
    shape = "".join(shapes[:1])
    sizes = []
    for key, count in _SIZES.get(shape, {}).items():
        sizes += _numbers(stated.get(key, ""), count)
    origin = [
        _numbers(stated.get(f"origin {part}", "0 0 0"), 3) for part in ("xyz", "rpy")
    ]
    file = stated.get("mesh filename", "")
    return Geometry(link, element.tag, shape, file, sizes, *origin)


def _numbers(text: str, count: int, finite: bool = True) -> list[float]:
    """So many numbers of an attribute."""
    numbers = [*map(float, text.split())]
    largest = float(np.abs(numbers).max(initial=0))  # nan if any of them is
    if len(numbers) != count or (finite and not largest < _MOST):
        words = "three finite numbers"
        if count == 1:
            words = "one finite number"
        raise ValueError(f"'{text}' are not {words}")
    return numbers


def _elements(data: bytes) -> list[Element]:
    """Links and joints of the robot. As in ROS, prefixes of names need no declaration."""
    blank = len(data) - len(data.lstrip())
    above: list[str] = []
    elements: list[Element] = []
    count = 0
    link = ""

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count, link
        count += 1
        require_at_most(count, "elements", "elements in XML")
        start = parser.CurrentByteIndex + blank
        if len(above) == 1 and tag in ("link", "joint"):
            elements.append(Element(tag, attributes, {tag: start}))
            link = attributes.get("name", "")
        elif above[1:] == ["link"] and tag in ("visual", "collision"):
            elements.append(Element(tag, {"link": link}, {tag: start}))
        elif above[1:2] == ["link"] and above[2:3] in (["visual"], ["collision"]):
            elements[-1].starts.setdefault(tag, start)
            for key, value in attributes.items():
                elements[-1].stated.setdefault(f"{tag} {key}", value)
        elif len(above) == 2 and above[1] == "joint":
            if tag in elements[-1].starts and tag in _PARTS:
                name = elements[-1].stated.get("name")
                raise ValueError(f"joint {name}: it has two of {tag}")
            elements[-1].starts[tag] = start
            for name, value in attributes.items():
                elements[-1].stated[f"{tag} {name}"] = value
        above.append(tag)

    def refuse(*_: object) -> None:
        raise ValueError("it has a DOCTYPE, which no URDF needs; remove it")

    parser = expat.ParserCreate()
    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda _: above.pop()
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data[blank:], True)
    except (expat.ExpatError, LookupError) as error:  # LookupError: its encoding
        raise ValueError(
            f"it is no XML: {error}; a part is missing, a tag is wrong, or the text is not UTF-8"
        ) from None
    return elements


def _joint(element: Element) -> Joint:
    name, kind, parent, child = map(element.stated.__getitem__, _ENDS)
    if parent == child:
        raise ValueError(f"'{child}' is its parent and its child")
    numbers = {}
    for key, default in _DEFAULTS.items():
        text = element.stated.get(key, default)
        finite = not key.startswith("limit")
        numbers[key] = _numbers(text, len(default.split()), finite)
    return Joint(name, kind, parent, child, numbers, element)
