"""Joint maps: values of joints from columns by a file, and columns by their names."""

import json
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.recordings import ReadOptions
from evercal.recordings.poses.joint_tables import read_joint_poses
from evercal.robot.joint_map import JointMap
from evercal.robot.joint_names import joints_by_column
from evercal.robot.robot_model import RobotModel

LEROBOT = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
SIX = [f"joint_{i}" for i in range(1, 7)]
YASKAWA = [f"joint_{i}_{letter}" for i, letter in enumerate("slurbt", 1)]
PANDA = [f"panda_joint{i}" for i in range(1, 8)]
UNIVERSAL = [
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    *(f"wrist_{i}_joint" for i in (1, 2, 3)),
]
NAMES = {
    "LeRobot": ([f"{name}.pos" for name in [*LEROBOT, "gripper"]], LEROBOT),
    "LeRobot, older": ([f"main_{name}" for name in [*LEROBOT, "gripper"]], LEROBOT),
    "SO-100": (["Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw"], LEROBOT),
    "numbered motors": (LEROBOT, ["1", "2", "3", "4", "5"]),
    "FANUC": (["J1", "J2", "J3", "J4", "J5", "J6"], SIX),
    "KUKA": (["A1", "A2", "A3", "A4", "A5", "A6"], [f"joint_a{i}" for i in range(1, 7)]),
    "Yaskawa": (["S", "L", "U", "R", "B", "T"], YASKAWA),
    "Franka": ([f"q{i}" for i in range(1, 8)], PANDA),
    "from zero": ([f"actual_q_{i}" for i in range(6)], UNIVERSAL),
    "another order": (["wrist_3", "wrist_2", "wrist_1", "elbow", "shoulder_lift", "shoulder_pan"],
                      UNIVERSAL[::-1]),
    "unknown words": (["base", "arm", "fore", "roll", "bend", "turn"], SIX),
}  # fmt: skip
"""Columns, and their joints in the same order."""
URDF = """<robot name="arm"><link name="base"/><link name="a"/><link name="b"/><link name="tip"/>
<joint name="J1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>
<joint name="J2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.5 0 0"/>
<axis xyz="0 0 1"/></joint>
<joint name="J3" type="prismatic"><parent link="b"/><child link="tip"/><axis xyz="1 0 0"/></joint>
</robot>"""


@pytest.mark.parametrize("vendor", sorted(NAMES))
def test_columns_are_joints_by_other_names(vendor: str) -> None:
    columns, joints = NAMES[vendor]
    found = joints_by_column(columns, joints, ordered=True)
    assert found == dict(zip(columns, joints, strict=False))


@pytest.mark.parametrize(
    "columns",
    [
        ["left.shoulder", "right.reach"],
        ["torque", "elbow"],
        ["x", "y"],
    ],
)
def test_columns_of_other_things_are_no_joints(columns: list[str]) -> None:
    assert joints_by_column(columns, ["shoulder", "reach", "wrist_1"], True) == {}


def write(folder: Path, entries: object) -> Path:
    file = folder / "map.json"
    file.write_text(json.dumps(entries))
    return file


def read(folder: Path, columns: str, row: str, entries: object) -> list[float]:
    (folder / "arm.urdf").write_text(URDF)
    (folder / "joints.csv").write_text(f"{columns}\n{row}\n")
    options = ReadOptions(joint_map=write(folder, entries))
    model = RobotModel(folder / "arm.urdf")
    poses, _ = read_joint_poses(folder / "joints.csv", model, options)
    assert poses.joints is not None
    return poses.joints[0].tolist()


def test_a_map_gives_sense_zero_unit_and_coupling(tmp_path: Path) -> None:
    entries = {
        "J1": {"columns": {"a": -1}, "unit": "deg", "offset_deg": 90},
        "J2": {"columns": {"b": 1, "a": 1}, "unit": 0.5},
        "J3": {"columns": {"c": 1}, "unit": "mm", "offset_m": 0.1},
    }
    values = read(tmp_path, "a,b,c", "30,60,200", {"joints": entries})
    np.testing.assert_allclose(values, [np.deg2rad(60), np.deg2rad(45), 0.3])
    # Joints that it does not name are read as without it.
    del entries["J3"]
    values = read(tmp_path, "a,b,J3", "30,60,0.2", {"joints": entries})
    np.testing.assert_allclose(values, [np.deg2rad(60), np.deg2rad(45), 0.2])


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    units = np.array([np.pi / 180, 2 * np.pi / 4096, 0.001])
    stated = JointMap.of_columns(["p", "q", "s"], ["x", "y", "z"], units)
    change = np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    changed = stated.after(change, np.array([0.5, -1.0, 0.2]))
    again = JointMap.read(write(tmp_path, changed.record([True, True, False])))
    values = np.array([[30.0, 1000.0, 20.0]])
    np.testing.assert_allclose(again.values(values), changed.values(values), atol=1e-5)
    expected = [[0.5 - np.deg2rad(30), 2000 * np.pi / 4096 - 1, 0.22]]
    np.testing.assert_allclose(changed.values(values), expected)


@pytest.mark.parametrize("unit", [0.002, 0.0005])
@pytest.mark.parametrize("turns", [True, False])
def test_any_unit_is_written(tmp_path: Path, unit: float, turns: bool) -> None:
    stated = JointMap.of_columns(["p"], ["x"], np.array([unit]))
    again = JointMap.read(write(tmp_path, stated.record([turns])))
    np.testing.assert_allclose(again.values(np.ones((1, 1))), unit, rtol=1e-6)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([], "holds no JSON object"),
        ({"joints": {}}, "no joint map; give"),
        ({"joints": {"J1": 3}}, "joint J1 is 3; give"),
        (
            {"joints": {"J1": {"columns": {"a": 1}, "unit": "grad"}}},
            "joint J1 is .*grad",
        ),
        ({"joints": {"J1": {"columns": {"a": 1}, "unit": "deg", "sgn": 1}}}, "sgn"),
        ({"joints": {"J1": {"columns": {}, "unit": "deg"}}}, "joint J1 is"),
        (
            {"joints": {"J1": {"columns": {"d": 1}, "unit": "deg"}}},
            "has no column d, which the joint map names; there are a, b, c",
        ),
    ],
)
def test_wrong_maps_are_refused(tmp_path: Path, entries: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(tmp_path, "a,b,c", "1,2,3", entries)


@pytest.mark.parametrize("row", ["0.1,0.2,0.3", "-1,90,4", "0,0,0"])
def test_rows_without_names_are_told_the_joints_of_the_urdf(
    tmp_path: Path, row: str
) -> None:
    (tmp_path / "arm.urdf").write_text(URDF)
    file = tmp_path / "joints.csv"
    file.write_text(f"a.png,{row}\nb.png,{row}\n")
    with pytest.raises(InputError, match=r"no names of joints; .* has J1,J2,J3$"):
        read_joint_poses(file, RobotModel(tmp_path / "arm.urdf"))


def test_numbers_of_motors_are_names(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(URDF)
    file = tmp_path / "joints.csv"
    file.write_text("image,1,2,3\na.png,0.1,0.2,0.3\n")
    poses, _ = read_joint_poses(file, RobotModel(tmp_path / "arm.urdf"))
    assert poses.joints is not None
    assert poses.joints.tolist() == [[0.1, 0.2, 0.3]]
