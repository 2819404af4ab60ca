"""Poses in brackets: robots' own notations, numpy's and Python's lists, as lines of a table.

Notations are tf2_echo of ROS, RAPID of ABB, LS of FANUC, URScript and KRL of KUKA.
"""

import re

from evercal.recordings.poses.conventions import Given, pose_convention
from evercal.recordings.poses.row_files import is_number

_WORD = r'[^\s\[\](){}=,;:"]'
_NOTATIONS = {
    "Translation: [": (
        r"(?:At time (\S+)\s+)?- Translation: \[([^\[\]]*)\]\s+- Rotation: in Quaternion[^\[\n]*"
        r"\[([^\[\]]*)\](?:\n(?!At time |- Translation).*)*",
        "x,y,z,qx,qy,qz,qw",
    ),
    "robtarget [": (
        r"()\[\s*\[([^\[\],]*(?:,[^\[\],]*){2})\]\s*,\s*\[([^\[\],]*(?:,[^\[\],]*){3})\]"
        r"\s*,\s*\[[^\[\]]*\]\s*,\s*\[[^\[\]]*\]\s*\]",
        "x_mm,y_mm,z_mm,qw,qx,qy,qz",
    ),
    "P[": (r"()\bP\[\d[^\[\]\n]*\]\s*\{([^{}]*)\}()", "X,Y,Z,W,P,R"),
    "p[": (
        rf'(?:(?<!{_WORD})({_WORD}++)[\s=,;:"]+)?p\[([^\[\]{{}}]*)\]()',
        "x,y,z,rotvec_x,rotvec_y,rotvec_z",
    ),
    "{": (
        rf'(?:(?<!{_WORD})({_WORD}++)[\s=,;:"]+)?\{{([^\[\]{{}}]*\bX\s+[-+.\d][^\[\]{{}}]*)\}}()',
        "X,Y,Z,A,B,C",
    ),
}
"""By how it begins: a pose as a pattern of a name or stamp and two groups, and its columns.

A word is read once, from its start."""

_TITLE = re.compile(r"^[^\[\]]*[:=]\s*(?=$|\[\[)")
"""Words before a matrix."""
_LABEL = re.compile(r"^([^\s,;:=]+)\s*(?::\s|=)\s*(?=[-+.\d])")
"""A name before numbers, such as P1 = 412.0."""


def without_brackets(lines: list[str], given: Given) -> tuple[list[str], Given]:
    """Lines of a table without brackets, and the convention that a robot's notation defines.

    ValueError: the lines mix notations, or numbers are beside the poses.
    """
    text = "\n".join(lines)
    kinds = [kind for kind in _NOTATIONS if re.search(_NOTATIONS[kind][0], text)]
    if len(kinds) > 1:
        raise ValueError(
            f"it mixes the brackets {' and '.join(sorted(kinds))}; use one notation"
        )
    if not kinds:
        return _without_lists(lines), given
    (kind,) = kinds
    pattern, columns = _NOTATIONS[kind]
    for line in re.sub(pattern, " ", text).splitlines():
        if _holds_numbers(line):
            raise ValueError(
                f"{line.strip()[:60]!r} is beside poses in {kind}; use one notation"
            )
    if not given and kind == "{":
        given = pose_convention("kuka")
    return _rows(re.findall(pattern, text), columns), given


def _holds_numbers(line: str) -> bool:
    cells = [*filter(None, re.split(r"[^\w.+#-]+", line))]
    numbers = sum(map(is_number, cells))
    return numbers > 2 and 2 * numbers > len(cells) and ":=" not in line


def _rows(poses: list[tuple[str, str, str]], columns: str) -> list[str]:
    """A header and a line for each pose."""
    labels = []
    rows = []
    for label, first, second in poses:
        labels.append(label)
        row = first
        if columns[0] == "X":
            values = dict(re.findall(r"\b([XYZABCWPR])[\s=]+([^\s,]+)", first))
            row = ",".join(values.get(letter, "") for letter in columns.split(","))
        elif second:
            row = f"{first},{second}"
        rows.append(row)
    # Labels that are all the same are a type, such as E6POS.
    is_type = len(labels) > 1 and len({*labels}) == 1
    if is_type or not all(labels):
        return [columns, *rows]
    label = "stamp" if is_number(labels[0]) else "image"
    labelled = zip(labels, rows, strict=True)
    return [f"{label},{columns}", *map(",".join, labelled)]


def _without_lists(lines: list[str]) -> list[str]:
    """Lines without the brackets of numpy, Python and robots' functions, such as XY(...)."""
    lines = [*filter(None, (_TITLE.sub("", line) for line in lines))]
    if not lines:
        return lines
    first = lines[0]
    separator = " "
    for character in "\t,;":
        if character in first:
            separator = character
    lines = [_LABEL.sub(rf"\1{separator}", line) for line in lines]
    if not re.search(r"((?<!\w)\[|[({])\s*[-+.\d]", lines[0]):
        return lines
    text = re.sub(r"\b\w+\(", "(", "\n".join(lines))
    # Wrapped by numpy.
    text = re.sub(r"\[[^\[\]]*\]", lambda row: row[0].replace("\n", " "), text)
    return re.sub(r'[\[\](){},;="]|:(?=\s)', " ", text).splitlines()
