"""The arm with the offsets of its joints: as JSON, in its URDF, in LeRobot's calibration file."""

import json
import re
from collections.abc import Mapping
from pathlib import Path

from evercal.calibration.export.request import Export, pose_numbers
from evercal.calibration.framed_pose import JointOffset
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.robot.robot_model import RobotModel
from evercal.robot.urdf import parsed_urdf
from evercal.storage.text_files import named_errors, read_json
from evercal.typing import JsonObject

_LEROBOT_TICKS = 4095 / 360
"""A degree of LeRobot is this many ticks: it divides by the resolution minus 1."""
_FEETECH_MOST = 2047
"""Largest offset of a Feetech motor, which has 11 bits and a sign for it."""
_OFFSET_SIGN = {"feetech": -1, "dynamixel": 1}
"""Sign of the homing offset in the position that the motor reports."""
_TAG = re.compile(rb"<(?:[^\"'>]|\"[^\"]*\"|'[^']*')*>")


def joint_offsets(export: Export) -> str:
    """Write offset, standard deviation and covariance; null where it is not determined."""
    _determined(export)
    rows: dict[str, JsonObject] = {}
    for joint in export.calibration.joints:
        row = rows.setdefault(joint.name, {"open": joint.open})
        units = {"m": 1.0}
        if joint.is_angle:
            units = {"rad": 1.0, "deg": joint.unit[1]}
        for unit, factor in units.items():
            row[f"offset_{unit}"] = factor * joint.offset
            row[f"sigma_{unit}"] = factor * joint.sigma
            if joint.open:
                row[f"offset_{unit}"] = None
    record = {
        "meaning": "add each offset to the value that the robot reports",
        "joints": rows,
        "covariance": export.calibration.joint_covariance.tolist(),  # rad and m
    }
    return json.dumps(record, indent=1, allow_nan=False) + "\n"


def corrected_urdf(export: Export) -> bytes:
    """Write the URDF with other origins of the joints; every other byte stays.

    From the values that the robot reports, its readers compute the poses of corrected ones.
    """
    offsets = {joint.name: joint.offset for joint in _determined(export)}
    file = export.options.get("urdf")
    if file is None:
        raise InputError("give the URDF of the arm that was recorded with `urdf`")
    model = RobotModel(file)
    for joint in export.calibration.joints:
        kind = "prismatic"
        if joint.is_angle:
            kind = "revolute"
        origin = model.origins_with({joint.name: 0.0}).get(joint.name)
        if not origin or origin[1] != joint.is_angle:
            raise InputError(
                f"{file}: has no {kind} joint {joint.name} with a value of its own; give the arm's"
                f" URDF"
            )
    with named_errors(model.path, "URDF"):
        return _with_origins(model.path.read_bytes(), model.origins_with(offsets))


def _with_origins(urdf: bytes, moved: Mapping[str, tuple[SE3, bool]]) -> bytes:
    """State the rotations of the origins of joints that rotate, the positions of others.

    The result is read again, and its numbers are compared with the wanted ones.
    """
    joints = {joint.name: joint for joint in parsed_urdf(urdf)[1]}
    wanted = {name: joint.numbers for name, joint in joints.items()}
    # The last first, so that places before it stay.
    for name in sorted(moved, key=lambda name: -joints[name].element.starts["joint"]):
        origin, rotates = moved[name]
        numbers = pose_numbers(origin, "rpy").tolist()
        key = "xyz"
        values = numbers[:3]
        if rotates:
            key = "rpy"
            values = numbers[3:]
        wanted[name] = {**wanted[name], f"origin {key}": values}
        attribute = f'<origin {key}="{" ".join(map(repr, values))}"'.encode()
        starts = joints[name].element.starts
        start = starts.get("origin", starts["joint"])
        match = _TAG.match(urdf, start)
        if match is None or b"\0" in match[0]:
            raise ValueError("its text is not UTF-8; save it so")
        pattern = rb"\s%s\s*=\s*(\"[^\"]*\"|'[^']*')" % key.encode()
        tag = re.sub(pattern, b"", match[0])
        if "origin" not in starts:
            tag += b"<origin/>"
        tag = tag.replace(b"<origin", attribute, 1)
        urdf = urdf[:start] + tag + urdf[match.end() :]
    written = {joint.name: joint.numbers for joint in parsed_urdf(urdf)[1]}
    if written != wanted:
        raise ValueError("its origins cannot be replaced; write them in a simpler way")
    return urdf


def lerobot(export: Export) -> str:
    """Write the calibration file with other homing offsets, rounded to whole ticks of the motor.

    Feetech's position is the encoder's minus the offset, Dynamixel's is the sum. The range stays,
    because zero degrees are in its middle.
    """
    file = export.options.get("lerobot_calibration")
    motors = export.options.get("lerobot_motors")
    determined = _determined(export)
    sign = _OFFSET_SIGN.get(str(motors), 0)
    if file is None or sign == 0:
        raise InputError(
            "give `lerobot_calibration` FILE, `lerobot_motors` feetech or dynamixel"
        )
    record = read_json(Path(file), "LeRobot calibration")
    for joint in determined:
        row = record.get(joint.name) if joint.is_angle else None
        if not isinstance(row, dict) or not isinstance(row.get("homing_offset"), int):
            raise InputError(
                f"{file}: has no homing_offset of a joint {joint.name} that turns"
            )
        ticks = round(joint.unit[1] * joint.offset * _LEROBOT_TICKS)
        row["homing_offset"] += sign * ticks
        if sign < 0 and abs(row["homing_offset"]) > _FEETECH_MOST:
            raise InputError(
                f"{file}: the homing offset of {joint.name} would exceed {_FEETECH_MOST}; calibrate"
                f" it in LeRobot with another middle first"
            )
    return json.dumps(record, indent=4) + "\n"


def _determined(export: Export) -> list[JointOffset]:
    """The offsets that are determined, at least one."""
    joints = export.calibration.joints
    if not joints:
        raise InputError(
            "no offsets of joints; record joints.csv and a URDF, not gripper poses"
        )
    determined = [joint for joint in joints if not joint.open]
    if not determined:
        why = "; ".join(f"{joint.name}: {joint.open}" for joint in joints)
        raise InputError(f"no offset is determined ({why})")
    return determined
