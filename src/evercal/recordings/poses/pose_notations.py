"""Poses as robots and programs print them, numpy's and Python's lists, as lines of a table.

Notations are tf2_echo of ROS, RAPID of ABB, LS of FANUC, URScript, KRL of KUKA, posx of Doosan,
HALCON's .dat, Redwood's .log (Open3D), autolab_core's .tf and prints, and prints of SAPIEN,
Pinocchio and Blender.
"""

import re

from evercal.recordings.poses.conventions import Given, pose_convention
from evercal.recordings.poses.row_files import is_number, separator_of

_WORD = r'[^\s\[\](){}=,;:"]'
_MATRIX = ",".join(f"m{row}{column}" for row in range(4) for column in range(4))
_ROTATION = "r00,r01,r02,r10,r11,r12,r20,r21,r22"
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
        "kuka",
    ),
    "posx(": (
        rf'(?:(?<!{_WORD})({_WORD}++)[\s=,;:"]+)?posx\(([^()]*)\)()',
        "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg",
        "moving_zyz",
    ),
    "f 0": (
        r"()(?m:^)f 0\nr ([^\n]*)\nt ([^\n]*)",
        "rx_deg,ry_deg,rz_deg,x_m,y_m,z_m",
        "moving_xyz",
    ),
    "f 2": (
        r"()(?m:^)f 2\nr ([^\n]*)\nt ([^\n]*)",
        "rx_deg,ry_deg,rz_deg,x_m,y_m,z_m",
        "fixed_xyz",
    ),
    "i i j": (
        r"(?m:^)()(?:\d+[ \t]+){2}\d+\n((?:\S+[ \t]+\S+[ \t]+\S+[ \t]+\S+(?:\n|\Z)){4})()",
        _MATRIX,
    ),
    "FROM TO": (
        r"(?m:^)()[A-Za-z]\w*\n[A-Za-z]\w*\n(\S+ \S+ \S+)\n((?:\S+ \S+ \S+(?:\n|\Z)){3})",
        f"x,y,z,{_ROTATION}",
    ),
    "Tra: [": (
        r"()Tra: \[([^\[\]]*)\]\s+Rot: \[[^Q]*\]\s+Qtn: \[([^\[\]]*)\](?:\s+from \S+ to \S+)?",
        "x,y,z,qw,qx,qy,qz",
    ),
    "RigidTransform(": (
        r"()RigidTransform\(rotation=np\.array\(([^()]*)\), translation=np\.array\(([^()]*)\)",
        f"{_ROTATION},x,y,z",
    ),
    "Pose(": (
        r"()\bPose\((?:p=)?\[([^\[\]]*)\],\s*(?:q=)?\[([^\[\]]*)\]\)",
        "x,y,z,qw,qx,qy,qz",
    ),
    "R =": (
        r"()(?m:^)R =\n((?:[^\n]*\n){3})p =([^\n]*)",
        f"{_ROTATION},x,y,z",
    ),
    "<Matrix 4x4": (r"()<Matrix 4x4 ([^<>]*)>()", _MATRIX),
}
"""By how it begins: a pose as a pattern of a name or stamp and two groups, its columns, and the
convention of angles. A word is read once, from its start."""
_OTHER = {
    r"(?m)^f (\d+)\nr ": "HALCON's representation type {}; write type 0 by convert_pose_type (Pose,"
    " 'Rp+T', 'gba', 'point')",
    r"(?m)^(?!(\d+)[ \t]+\1[ \t])(\d+[ \t]+\d+)[ \t]+\d+\n(?:\S+[ \t]+){3}\S+\n": "motions"
    " between pairs of fragments, the first {}; give the trajectory",
}
"""What a notation is that holds no poses, by pattern."""

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
    for other, problem in _OTHER.items():
        match = re.search(other, text)
        if match and match[1] not in ("0", "2"):
            raise ValueError(problem.format(match[match.lastindex or 1]))
    if not kinds:
        return _without_lists(lines), given
    (kind,) = kinds
    pattern, columns, *convention = _NOTATIONS[kind]
    for line in re.sub(pattern, " ", text).splitlines():
        cells = [*filter(None, re.split(r"[^\w.+#-]+", line))]
        numbers = sum(map(is_number, cells))
        if numbers > 2 and 2 * numbers > len(cells) and ":=" not in line:
            raise ValueError(
                f"{line.strip()[:60]!r} is beside poses in {kind}; use one notation"
            )
    if not given and convention:
        given = pose_convention(convention[0])
    return _rows(re.findall(pattern, text), columns), given


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
        elif second or columns == _MATRIX:
            row = re.sub(r"[\s,;()\[\]]+", ",", f"{first},{second}").strip(",")
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
    separator = separator_of(lines[0])
    lines = [_LABEL.sub(rf"\1{separator}", line) for line in lines]
    if not re.search(r"((?<!\w)\[|[({])\s*[-+.\d]", lines[0]):
        return lines
    text = re.sub(r"\b\w+\(", "(", "\n".join(lines))
    # Wrapped by numpy.
    text = re.sub(r"\[[^\[\]]*\]", lambda row: row[0].replace("\n", " "), text)
    return re.sub(r'[\[\](){},;="]|:(?=\s)', " ", text).splitlines()
