"""Robot controllers and Zivid: poses as their programs write them.

The conventions are in `evercal.recordings.poses.conventions`. The pose is parent_from_child: that
of the camera in the robot's base or on its flange. Zivid's file was checked against the one that
its Python samples write and its SDK loads: millimetres, under FloatMatrix.
"""

import json

import yaml

from evercal.calibration.export.request import Export
from evercal.recordings.poses.conventions import numbers_from_poses, pose_convention


def zivid(export: Export) -> str:
    """The 4x4 matrix in millimetres as YAML."""
    rows = numbers_from_poses(export.pose, pose_convention("matrix:mm")).reshape(4, 4) + 0.0
    record = {
        "__version__": {"serializer": 1, "data": 1},
        "FloatMatrix": {"Data": rows.tolist()},
    }
    return yaml.safe_dump(record, sort_keys=False, default_flow_style=None)


def ur(export: Export) -> str:
    """A pose of URScript: metres and rotation vector."""
    return f"# {export.sentence}\np[{', '.join(_fixed(export, 'ur'))}]\n"


def kuka(export: Export) -> str:
    """A FRAME of KRL: millimetres and degrees, A about z, then B about y, then C about x."""
    words = zip("XYZABC", _fixed(export, "kuka"), strict=True)
    return f"; {export.sentence}\n{{{', '.join(f'{k} {v}' for k, v in words)}}}\n"


def abb(export: Export) -> str:
    """A pose of RAPID: millimetres and quaternion."""
    numbers = _fixed(export, "abb")
    return f"! {export.sentence}\n[[{','.join(numbers[:3])}],[{','.join(numbers[3:])}]]\n"


def fanuc(export: Export) -> str:
    """X Y Z in millimetres, W P R in degrees about fixed x, y, z."""
    return _lines(export, "fanuc", ("X", "Y", "Z", "W", "P", "R"))


def yaskawa(export: Export) -> str:
    """X Y Z in millimetres, Rx Ry Rz in degrees about fixed x, y, z."""
    return _lines(export, "yaskawa", ("X", "Y", "Z", "Rx", "Ry", "Rz"))


def staubli(export: Export) -> str:
    """X Y Z in millimetres, RX RY RZ in degrees about moved x, y, z."""
    return _lines(export, "staubli", ("X", "Y", "Z", "RX", "RY", "RZ"))


def franka(export: Export) -> str:
    """16 numbers column after column, metres, as libfranka's O_T_EE, in JSON."""
    numbers = numbers_from_poses(export.pose, pose_convention("franka")) + 0.0
    return json.dumps(numbers.tolist()) + "\n"


def _lines(export: Export, convention: str, keys: tuple[str, ...]) -> str:
    """A heading and a line of numbers, for people to type in."""
    numbers = _fixed(export, convention)
    return f"# {export.sentence}\n{' '.join(keys)}\n{' '.join(numbers)}\n"


def _fixed(export: Export, convention: str) -> list[str]:
    """Nine decimals and no exponents, which not every controller reads."""
    numbers = numbers_from_poses(export.pose, pose_convention(convention))
    return [f"{round(value, 9) + 0.0:.9f}" for value in numbers.tolist()]
