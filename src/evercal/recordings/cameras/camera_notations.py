"""Texts of camera files as nested entries: JSON, YAML, XML, Python, INI and lines of names.

What the entries mean is decided by `camera_blocks` and `camera_fields`.
"""

import ast
import re
from contextlib import suppress
from typing import Any

import numpy as np

from evercal.recordings.cameras.colmap_models import colmap_fields
from evercal.recordings.poses.row_files import is_number
from evercal.storage.text_files import documents
from evercal.typing import JsonObject

EXPECTED = (
    "give a 3x3 matrix as text, JSON, YAML or NPZ with camera_matrix and dist_coeffs, a ROS"
    " camera_info or OpenCV's storage"
)
"""What a camera file may hold, for messages."""
_COMMENT = re.compile(r"(^|\s)[#;].*")
_SECTION = re.compile(r"\[([^\[\]]+)\]")
_PAIR = re.compile(r"([A-Za-z_][^:=]*)[:=]+\s*(.*)")
_NEXT_PAIR = re.compile(r"[,;]\s*(?=[A-Za-z_][\w .]*[:=])")
_NAMED_NUMBERS = re.compile(r"([A-Za-z_]\w*)((?:[\s,]+[-+.\d][-+.\deE]*)+)")
_BRACKETS = str.maketrans("", "", "[](){}<>,;\"'")
_REALSENSE = re.compile(
    r"(?<!\d)(?P<width>\d+)x(?P<height>\d+)\s+p\[(?P<cx>\S+) (?P<cy>\S+)\]\s+"
    r"f\[(?P<fx>\S+) (?P<fy>\S+)\]\s+(?P<model>[A-Za-z ]+) \[(?P<coeffs>.*?)\]"
)
"""Intrinsics as pyrealsense2 prints them."""
_COLMAP = re.compile(
    r"^ *(\d+) +([A-Z_]{3,}) +(\d+) +(\d+)((?: +[-+.\deE]+)+) *$", re.MULTILINE
)
"""A line of COLMAP's cameras.txt."""


def entries_of(text: str) -> JsonObject:
    """Nested entries of a text in one of the notations; ValueError for other text."""
    body = re.sub(r"\A(\s*#.*\n)+", "", text)
    start = body.lstrip()[:1]
    if re.match(r"\s*<[?!\w]", body):
        return _of_xml(text)
    rows = [row.groupdict() for row in _REALSENSE.finditer(text)]
    for name, model, width, height, words in _COLMAP.findall(text):
        numbers = [*map(float, words.split())]
        rows.append(
            {"name": name, **colmap_fields(model, float(width), float(height), numbers)}
        )
    if rows:
        return {"cameras": rows}
    problem = ""
    try:
        # A printed message ends with '---', which opens a second, empty document.
        data, *_ = [*documents(body, start == "{"), None]
        if start == "[" and isinstance(data, list):
            data = {"cameras": data}
        if isinstance(data, dict):
            return data
    except ValueError as error:
        problem = str(error)
        if not problem.startswith("not valid"):
            raise
        line = re.search(r"line \d+", problem)
        problem = f"{problem[:14]} ({line[0]})" if line else problem[:14]
    if start == "{":
        with suppress(ValueError, SyntaxError):
            data = ast.literal_eval(body.strip())
            if isinstance(data, dict):
                return data
    data = {} if start == "{" else _of_lines(text)
    if not data:
        raise ValueError(f"{problem or 'no camera in it'}; {EXPECTED}")
    return data


def value_of(words: str) -> Any:
    """A number, a list of numbers, or else the words."""
    cells = words.translate(_BRACKETS).split()
    if len(cells) < 2:
        cells = words.replace(",", " ").translate(_BRACKETS).split()
    if not cells or not all(map(is_number, cells)):
        return words.strip("\"' ")
    numbers = [*map(float, cells)]
    if len(numbers) == 1:
        return numbers[0]
    return numbers


def _of_lines(text: str) -> JsonObject:
    """Entries of lines: [sections], headings, `name: value`, `name = value`, and numbers.

    Empty if brackets stay open, a name comes twice, or there are no numbers.
    """
    if text.count("[") != text.count("]") or text.count("{") != text.count("}"):
        return {}
    data: JsonObject = {}
    section = block = holder = data
    key = ""
    for raw in text.splitlines():
        line = _COMMENT.sub("", raw).strip()
        titled = isinstance(value_of(line), str) and _SECTION.fullmatch(line)
        named = _NAMED_NUMBERS.fullmatch(line) or _PAIR.fullmatch(line)
        if not line:
            continue
        if titled:
            section = block = data.setdefault(titled[1].strip(), {})
        elif named and named[2]:
            for part in _NEXT_PAIR.split(line):
                pair = _NAMED_NUMBERS.fullmatch(part) or _PAIR.fullmatch(part)
                key = pair[1].strip() if pair else ""
                if not pair or key in block:
                    return {}
                holder = block
                block[key] = value_of(pair[2])
        elif isinstance(value_of(line), str):
            key = line.rstrip(": ")
            if key in section:
                key += f" ({len(section)})"
            holder = section
            block = section[key] = {}
        else:
            held = holder.get(key) or []
            holder[key] = held if isinstance(held, list) else [held]
            holder[key] += np.atleast_1d(value_of(line)).tolist()
    return data if any(data.values()) else {}


def _of_xml(text: str) -> JsonObject:
    from xml.etree import ElementTree

    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities can expand without bound
        raise ValueError("it declares XML entities")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        where = f"line {error.position[0]}"
        raise ValueError(f"not valid XML ({where}); {EXPECTED}") from None
    value = _xml_value(root)
    return value if isinstance(value, dict) else {root.tag: value}


def _xml_value(element: Any) -> Any:
    """An array, a list, an object of attributes and children, or else a word or numbers."""
    data = element.find("data")
    if data is not None:
        return {"data": (data.text or "").split()}
    children = [*element]
    if children and children[0].tag == "_":
        return [*map(_xml_value, children)]
    entry: JsonObject = {}
    for name, words in element.attrib.items():
        entry[name] = value_of(words)
    groups: dict[str, list[Any]] = {}
    for child in children:
        groups.setdefault(child.tag, []).append(_xml_value(child))
    for tag, values in groups.items():
        entry[tag] = values[0] if len(values) == 1 else values
    words = (element.text or "").strip()
    if not entry:
        return value_of(words)
    if words:
        entry["text"] = value_of(words)
    return entry
