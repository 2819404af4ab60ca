"""The arm with the offsets of its joints: as JSON, in its URDF, in LeRobot's calibration file."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from xml.parsers import expat

from evercal.calibration.calibration import JointOffset
from evercal.calibration.export.request import Export, pose_numbers
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.kinematics import RobotModel
from evercal.recordings.text_files import library_errors, read_json, read_text

_LEROBOT_TICKS = 4095 / 360
"""A degree of LeRobot is this many ticks: it divides by the resolution minus 1."""
_MOST_FEETECH = 2047
"""The motor has 11 bits and a sign for the offset."""
_TAG = re.compile(rb"<(?:[^\"'>]|\"[^\"]*\"|'[^']*')*>")


def joint_offsets(export: Export) -> str:
    """Write offset, standard deviation and covariance; null where it is not determined."""
    joints, rows = _joints(export), {}
    for joint in joints:
        units = {"rad": 1.0, "deg": joint.unit[1]} if joint.is_angle else {"m": 1.0}
        offset = None if joint.open else joint.offset
        rows[joint.name] = {
            **{f"offset_{unit}": offset and times * offset for unit, times in units.items()},
            **{f"sigma_{unit}": times * joint.sigma for unit, times in units.items()},
            "open": joint.open,
        }
    record = {
        "meaning": "add each offset to the value that the robot reports",
        "joints": rows,
        "covariance": export.calibration.joint_covariance.tolist(),
        "covariance_unit": "rad and m, in the order of joints",
    }
    return json.dumps(record, indent=1, allow_nan=False) + "\n"


def corrected_urdf(export: Export) -> str:
    """Write the URDF with other origins of the joints; the rest of the text stays.

    From the values that the robot reports, its readers compute the poses of corrected ones.
    """
    joints, file = _joints(export), export.options.get("urdf")
    if file is None:
        raise InputError("give the URDF of the arm that was recorded with --urdf")
    model = RobotModel(file)
    moved = model.origins_with({j.name: j.offset for j in _determined(export)})
    for joint in joints:
        own = model.origins_with({joint.name: 0.0}).get(joint.name)
        if own is None or own[1] != joint.is_angle:
            kind = "revolute" if joint.is_angle else "prismatic"
            raise InputError(
                f"{file}: has no {kind} joint {joint.name} with a value of its own; give the URDF"
                " of the recording"
            )
    changed = {}
    for name, (origin, rotates) in moved.items():
        numbers = pose_numbers(SE3.from_matrix(origin), "rpy").tolist()
        key, values = (b"rpy", numbers[3:]) if rotates else (b"xyz", numbers[:3])
        changed[name] = key, b'"%s"' % " ".join(map(repr, values)).encode()
    text = read_text(Path(file), "URDF")
    other = r"""(<\?xml[^>]*encoding\s*=\s*)["'](?!utf-8["'])[^"']*["']"""
    text = re.sub(other, r'\1"utf-8"', text, count=1, flags=re.IGNORECASE)
    text = text.replace("\n", "\r\n") if b"\r\n" in Path(file).read_bytes() else text
    with library_errors(f"{file}: no usable URDF"):
        return _with_origins(text.encode(), changed).decode()


def _with_origins(data: bytes, changed: Mapping[str, tuple[bytes, bytes]]) -> bytes:
    """Set an attribute of the origins of joints, by name of the joint, as quoted text."""
    parser = expat.ParserCreate("utf-8")
    path: list[tuple[str, str]] = []
    places: dict[str, tuple[int, str]] = {}

    def begin(tag: str, attributes: dict[str, str]) -> None:
        path.append((tag, attributes.get("name", "")))
        name = path[1][1] if len(path) in (2, 3) and path[1][0] == "joint" else None
        first = tag == "origin" and places.get(name or "", (0, ""))[1] == "joint"
        if name in changed and (len(path) == 2 or first):
            places[name] = parser.CurrentByteIndex, tag

    def end_of(_: str) -> None:
        path.pop()

    parser.StartElementHandler, parser.EndElementHandler = begin, end_of
    parser.Parse(data, True)
    for name, (start, tag) in sorted(places.items(), key=lambda item: -item[1][0]):
        key, value = changed[name]
        matched = _TAG.match(data, start)
        assert matched, "expat has read this tag"
        end = matched.end()
        if tag == "joint":  # which has no origin
            new = data[start:end] + b"<origin %s=%s/>" % (key, value)
        else:
            stated = rb"(\s%s\s*=\s*)(\"[^\"]*\"|'[^']*')" % key
            new, count = re.subn(stated, rb"\g<1>" + value, data[start:end])
            new = new if count else new.replace(b"<origin", b"<origin %s=%s" % (key, value), 1)
        data = data[:start] + new + data[end:]
    return data


def lerobot(export: Export) -> str:
    """Write the calibration file with other homing offsets, rounded to whole ticks of the motor.

    Feetech's position is the encoder's minus the offset, Dynamixel's is the sum. The range stays,
    so its middle, which is zero degrees, moves with the offset.
    """
    joints = _determined(export)
    file, motors = (export.options.get(f"lerobot_{word}") for word in ("calibration", "motors"))
    if file is None or motors is None:
        raise InputError(
            "give the calibration file of the arm with --lerobot-calibration, and its motors with"
            " --lerobot-motors feetech or dynamixel"
        )
    record = read_json(Path(file), "LeRobot calibration")
    for joint in joints:
        row = record.get(joint.name)
        if not (isinstance(row, dict) and isinstance(row.get("homing_offset"), int)):
            raise InputError(f"{file}: has no homing_offset of joint {joint.name}; give its file")
        if not joint.is_angle:
            raise InputError(f"joint {joint.name} slides, and LeRobot's joints turn")
        ticks = round(joint.unit[1] * joint.offset * _LEROBOT_TICKS)
        row["homing_offset"] += ticks if motors == "dynamixel" else -ticks
        if motors == "feetech" and abs(row["homing_offset"]) > _MOST_FEETECH:
            raise InputError(
                f"{file}: joint {joint.name} would have the homing offset {row['homing_offset']},"
                f" and the motor takes {_MOST_FEETECH} at most: calibrate it in LeRobot with its"
                " middle elsewhere, and record again"
            )
    return json.dumps(record, indent=4) + "\n"


def _joints(export: Export) -> tuple[JointOffset, ...]:
    joints = export.calibration.joints
    if not joints:
        raise InputError(
            "this calibration has no offsets of joints; record joints.csv with a URDF instead of"
            " gripper poses, and learn again"
        )
    return joints


def _determined(export: Export) -> list[JointOffset]:
    joints = _joints(export)
    if all(joint.open for joint in joints):
        why = "; ".join(f"{joint.name}: {joint.open}" for joint in joints)
        raise InputError(f"no offset is determined ({why})")
    return [joint for joint in joints if not joint.open]
