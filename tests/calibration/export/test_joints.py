"""Offsets of joints: in a URDF, in JSON, in LeRobot's calibration file."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from evercal.calibration.calibration import Calibration, JointOffset
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.robot.robot_model import RobotModel

from .random_poses import calibration_of

URDF = """<?xml version="1.0"?>
<robot name="arm">
  <!-- <joint name="elbow"><origin rpy="9 9 9"/></joint> is only a comment -->
  <link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
  <link name="e"/><link name="tip"/>
  <joint name="pan" type="revolute"><parent link="base"/><child link="a"/>
    <origin xyz="0 0 0.2" rpy="0.1 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint type='revolute' name='elbow'><parent link='a'/><child link='b'/>
    <visual note="a > b"><origin xyz="7 7 7" rpy="7 7 7"/></visual>
    <origin rpy = '0.3 -0.2 1.1'
            xyz='0.3 0.1 0'></origin><axis xyz='0 2 1'/>
    <limit lower='-3' upper='3' effort='1' velocity='1'/></joint>
  <joint name="rail" type="prismatic"><parent link="b"/><child link="c"/>
    <origin xyz="0.1 0 0" rpy="0.2 0.4 0"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="wrist" type="continuous"><parent link="c"/><child link="d"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="follower" type="revolute"><parent link="d"/><child link="e"/>
    <origin xyz="0 0 0.1"/><axis xyz="1 0 0"/><mimic joint="elbow" multiplier="-0.5" offset="0.2"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="flange" type="fixed"><parent link="e"/><child link="tip"/>
    <origin xyz="0 0 .1"/></joint>
  <transmission name="t"><joint name="elbow"><origin xyz="0 0 0"/></joint></transmission>
</robot>
"""
JOINTS = (
    JointOffset("pan", 0.0, 0.02, open="its offset turns the frame of the base"),
    JointOffset("elbow", 0.031, 0.002),
    JointOffset("rail", -0.004, 0.0005, is_angle=False),
    JointOffset("wrist", -0.022, 0.003),
)
OFFSETS = np.array([0.0, 0.031, -0.004, -0.022])
ARM = replace(
    calibration_of(SE3.identity(), "eye_in_hand"),
    joints=JOINTS,
    joint_covariance=np.diag([4e-4, 4e-6, 2.5e-7, 9e-6]),
)
LEROBOT = {
    name: {
        "id": i,
        "drive_mode": 0,
        "homing_offset": 100,
        "range_min": 800,
        "range_max": 3101,
    }
    for i, name in enumerate(("pan", "elbow", "wrist", "gripper"), 1)
}


def with_joints(*joints: JointOffset) -> Calibration:
    covariance = np.diag([joint.sigma**2 for joint in joints])
    return replace(ARM, joints=joints, joint_covariance=covariance)


def file_of(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    (folder / "arm.urdf").write_bytes(text.encode(encoding))
    return folder / "arm.urdf"


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (URDF, "utf-8"),
        (URDF.replace("\n", "\r\n"), "utf-8"),
        (
            URDF.replace('"1.0"?>', '"1.0" encoding="ISO-8859-1"?>').replace(
                "only", "für"
            ),
            "latin-1",
        ),
        (URDF.replace("only", "für"), "utf-8-sig"),
    ],
)
def test_reported_values_give_the_poses_of_corrected_ones(
    tmp_path: Path, text: str, encoding: str
) -> None:
    file = file_of(tmp_path, text, encoding)
    new = tmp_path / "new.urdf"
    ARM.export("corrected_urdf", new, urdf=file)
    values = np.random.default_rng(1).uniform(-1, 1, (20, 4))
    before, after = (RobotModel(path).arm("base", "tip") for path in (file, new))
    assert before.joints == tuple(joint.name for joint in JOINTS)
    wanted = before.poses(values + OFFSETS)
    assert np.max(pose_distance(after.poses(values), wanted)) < 1e-9
    assert np.min(pose_distance(before.poses(values), wanted)[0]) > 1e-3


def test_the_rest_of_the_urdf_stays(tmp_path: Path) -> None:
    old = URDF.replace("\n", "\r\n")
    ARM.export("corrected_urdf", tmp_path / "new.urdf", urdf=file_of(tmp_path, old))
    new = (tmp_path / "new.urdf").read_bytes().decode()
    pairs = zip(old.split("\n"), new.split("\n"), strict=True)
    differ = [pair for pair in pairs if pair[0] != pair[1]]
    for was, now in differ:
        kept = [
            re.sub(" (rpy|xyz) ?= ?[\"'][-\\d.e ]*[\"']", "", line)
            for line in (was, now)
        ]
        assert kept[0].replace("<origin/>", "") == kept[1].replace("<origin/>", "")
    # elbow, rail, wrist, and the follower of elbow.
    assert [was.strip()[:13] for was, _ in differ] == [
        "<origin rpy =", "<origin xyz=\"", "<joint name=\"", "<origin xyz=\""
    ]  # fmt: skip


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_a_urdf_of_two_bytes_a_letter_is_refused(tmp_path: Path, encoding: str) -> None:
    text = URDF.replace('"1.0"?>', '"1.0" encoding="utf-16"?>')
    file = file_of(tmp_path, text, encoding)
    assert RobotModel(file).arm("base", "tip").joints[1] == "elbow"
    with pytest.raises(
        InputError, match=r"arm.urdf: its text is not UTF-8; save it so"
    ):
        ARM.export("corrected_urdf", tmp_path / "new.urdf", urdf=file)
    assert not (tmp_path / "new.urdf").exists()


@pytest.mark.parametrize(
    ("removed", "message"),
    [
        (rb"nothing", "is no XML: duplicate attribute"),
        (rb" (xyz|rpy) ?=[^/>]*", "origins cannot be replaced"),
    ],
)
def test_a_urdf_that_was_written_wrong_is_not_kept(
    tmp_path: Path, removed: bytes, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The replaced attribute stays, or the other one is lost as well."""
    replaced = re.sub

    def wrong(pattern: bytes, new: bytes, tag: bytes) -> bytes:
        return replaced(removed, new, tag)

    monkeypatch.setattr("evercal.calibration.export.joints.re.sub", wrong)
    still = with_joints(JOINTS[1])
    file = file_of(tmp_path, URDF)
    with pytest.raises(InputError, match=rf"arm.urdf: .*{message}"):
        still.export("corrected_urdf", tmp_path / "new.urdf", urdf=file)
    assert not (tmp_path / "new.urdf").exists()


def test_offsets_of_zero_leave_the_poses(tmp_path: Path) -> None:
    """Gimbal lock at a pitch of 90 degrees included."""
    file = file_of(tmp_path, URDF.replace("0.2 0.4 0", "0.2 1.5707963267948966 0.3"))
    new = tmp_path
    still = with_joints(*(replace(joint, offset=0.0) for joint in JOINTS))
    still.export("corrected_urdf", new / "new.urdf", urdf=file)
    values = np.random.default_rng(1).uniform(-1, 1, (5, 4))
    before, after = (RobotModel(p).arm("base", "tip") for p in (file, new / "new.urdf"))
    assert np.max(pose_distance(before.poses(values), after.poses(values))) < 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("'elbow'", "'other'"), "arm.urdf: has no revolute joint elbow with a value of its own"),
        (('"rail" type="prismatic"', '"rail" type="revolute"'), "has no prismatic joint rail"),
        (('"wrist" type="continuous"', '"wrist" type="fixed"'), "has no revolute joint wrist"),
        (('"pan" type="revolute"', '"p" type="revolute"'), "has no revolute joint pan"),
        (('<axis xyz="0 1 0"/>', '<mimic joint="pan"/>'), "has no revolute joint wrist"),
        (('name="flange"', 'name="wrist"'), "'wrist' comes twice; give each link and each joint"),
        (('xyz="0.1 0 0"', 'quat_xyzw="0 0 0 1"'), "joint rail is turned by quat_xyzw"),
    ],
)  # fmt: skip
def test_a_urdf_of_another_arm_is_refused(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    text = URDF.replace(*change)
    if "other" in change[1]:
        text = text.replace('mimic joint="elbow"', 'mimic joint="other"')
    assert text != URDF
    with pytest.raises(InputError, match=message):
        ARM.export("corrected_urdf", urdf=file_of(tmp_path, text))


@pytest.mark.parametrize("name", ["joint_offsets", "corrected_urdf", "lerobot"])
def test_a_calibration_without_joints_says_what_to_record(name: str) -> None:
    with pytest.raises(
        InputError, match=f"{name}: .* record joints.csv and a URDF, not"
    ):
        calibration_of(SE3.identity()).export(name)


def test_missing_options_and_undetermined_joints_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"give the URDF of the arm .* with `urdf`"):
        ARM.export("corrected_urdf")
    with pytest.raises(InputError, match="`lerobot_motors` feetech or dynamixel"):
        ARM.export("lerobot", lerobot_calibration=tmp_path / "arm.json")
    still = with_joints(replace(JOINTS[1], open="move elbow more between the images"))
    with pytest.raises(
        InputError, match=r"no offset is determined \(elbow: move elbow more"
    ):
        still.export("corrected_urdf", urdf=file_of(tmp_path, URDF))


def test_json_states_units_and_what_is_open() -> None:
    record = json.loads(ARM.export("joint_offsets"))
    joints = record["joints"]
    assert [*joints] == ["pan", "elbow", "rail", "wrist"]
    assert joints["pan"]["offset_rad"] is joints["pan"]["offset_deg"] is None
    assert joints["pan"]["open"].startswith("its offset turns")
    assert joints["elbow"]["offset_deg"] == pytest.approx(np.rad2deg(0.031))
    assert joints["elbow"]["sigma_rad"] == 0.002
    assert joints["rail"] == {"offset_m": -0.004, "sigma_m": 0.0005, "open": ""}
    assert_array_equal(record["covariance"], ARM.joint_covariance)
    zero = with_joints(replace(JOINTS[1], offset=0.0)).export("joint_offsets")
    assert json.loads(zero)["joints"]["elbow"]["offset_deg"] == 0.0


def degrees(row: dict[str, Any], motors: str, encoder: int) -> float:
    """What LeRobot 0.4.4 reports: the middle of the range is zero, and 4095 ticks are a turn."""
    offset = row["homing_offset"]
    present = encoder + offset if motors == "dynamixel" else encoder - offset
    return (present - (row["range_min"] + row["range_max"]) / 2) * 360 / 4095


@pytest.mark.parametrize("motors", ["feetech", "dynamixel"])
def test_lerobot_reports_corrected_degrees(tmp_path: Path, motors: Any) -> None:
    (tmp_path / "arm.json").write_text(json.dumps(LEROBOT, indent=4))
    turning = with_joints(*(joint for joint in JOINTS if joint.is_angle))
    options = {"lerobot_calibration": tmp_path / "arm.json", "lerobot_motors": motors}
    record = json.loads(turning.export("lerobot", **options))
    assert [*record] == [*LEROBOT]
    for joint in JOINTS:
        if joint.is_angle:
            before, after = (
                degrees(r[joint.name], motors, 2300) for r in (LEROBOT, record)
            )
            # Half a tick.
            assert after - before == pytest.approx(np.rad2deg(joint.offset), abs=0.044)
    assert abs(record["elbow"]["homing_offset"] - 100) == 20
    for name in ("pan", "gripper"):
        assert record[name] == LEROBOT[name]
    for row in record.values():
        assert type(row.pop("homing_offset")) is int
        assert (row["range_min"], row["range_max"], row["drive_mode"]) == (800, 3101, 0)


@pytest.mark.parametrize(
    ("joints", "homing", "message"),
    [
        ((JOINTS[2],), 100, "arm.json: has no homing_offset of a joint rail"),
        ((replace(JOINTS[2], name="wrist"),), 100, "of a joint wrist that turns"),
        ((JOINTS[3],), 2040, "offset of wrist would exceed 2047"),
        ((JOINTS[3],), "100", "has no homing_offset of a joint wrist"),
    ],
)  # fmt: skip
def test_other_arms_of_lerobot_are_refused(
    tmp_path: Path, joints: tuple[JointOffset, ...], homing: Any, message: str
) -> None:
    record = {**LEROBOT, "wrist": {**LEROBOT["wrist"], "homing_offset": homing}}
    (tmp_path / "arm.json").write_text(json.dumps(record))
    options = {
        "lerobot_calibration": tmp_path / "arm.json",
        "lerobot_motors": "feetech",
    }
    with pytest.raises(InputError, match=message):
        with_joints(*joints).export("lerobot", **options)
