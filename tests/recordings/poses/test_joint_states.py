"""Gripper poses from joints: a planar arm's closed form, the Panda's published parameters."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.recordings import ReadOptions, load_recording, write_image
from evercal.recordings.poses.joint_tables import interpolate, read_joint_poses
from evercal.robot.robot_model import RobotModel

from ..checks import assert_pose, refused

# Two links of 0.5 and 0.3 m in the plane, on a column of 0.2 m; a slide at the end moves along x.
PLANAR = """<robot name="planar">
  <link name="base"/><link name="upper"/><link name="lower"/><link name="slide"/><link name="tip"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.2"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.5 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="reach" type="prismatic"><parent link="lower"/><child link="slide"/>
    <origin xyz="0.3 0 0"/><axis xyz="2 0 0"/><limit lower="0" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="fixed" type="fixed"><parent link="slide"/><child link="tip"/>
    <origin xyz="0 0 -0.1" rpy="0 0 0"/></joint>
</robot>"""
ANGLES = st.floats(-2.9, 2.9)


def planar(shoulder: float, elbow: float, reach: float) -> SE3:
    """The tip in the base, from the drawing."""
    a = shoulder
    b = shoulder + elbow
    far = 0.3 + reach
    x = 0.5 * np.cos(a) + far * np.cos(b)
    y = 0.5 * np.sin(a) + far * np.sin(b)
    return SE3(np.array([np.cos(b / 2), 0, 0, np.sin(b / 2)]), np.array([x, y, 0.1]))


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("urdf") / "planar.urdf"
    file.write_text(PLANAR)
    return file


@pytest.fixture(scope="module")
def model(urdf: Path) -> RobotModel:
    return RobotModel(urdf)


@given(ANGLES, ANGLES, st.floats(0, 1))
def test_planar_arm_agrees_with_its_closed_form(
    model: RobotModel, shoulder: float, elbow: float, reach: float
) -> None:
    # In another order than the chain's, with a joint that the arm has not.
    values = np.array([[9.0, reach, shoulder, elbow]])
    names = ["finger", "reach", "shoulder", "elbow"]
    poses = model.poses(names, values, "base", "tip").poses
    metres, radians = pose_distance(poses[0], planar(shoulder, elbow, reach))
    assert max(metres, radians) < 1e-7  # trimesh takes 1e-8 for nothing


def test_any_two_links_can_be_chosen(model: RobotModel) -> None:
    assert model.chosen_links(None, None) == ("base", "tip")
    assert model.arm("base", "tip").joints == ("shoulder", "elbow", "reach")
    assert model.arm("upper", "lower").joints == ("elbow",)
    assert model.arm("tip", "lower").joints == ("reach",)
    pose_in_degrees = model.poses(["elbow"], np.array([[0.7]]), "lower", "upper").poses[
        0
    ]
    expected = SE3.exp([0.5, 0, 0, 0, 0, 0]) @ SE3.exp([0, 0, 0, 0, 0, 0.7])
    assert max(pose_distance(pose_in_degrees, expected.inverse())) < 1e-9


def panda_flange(q: np.ndarray) -> SE3:
    """Franka's documented Denavit-Hartenberg parameters (Craig's convention)."""
    a = [0, 0, 0, 0.0825, -0.0825, 0, 0.088, 0]
    d = [0.333, 0, 0.316, 0, 0.384, 0, 0, 0.107]
    alpha = [0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2, 0]
    base_from_joint = SE3.identity()
    for i in range(8):
        along_x = SE3.exp([0, 0, 0, alpha[i], 0, 0]).rotation_wxyz
        before = SE3(along_x, np.array([a[i], 0.0, 0.0]))
        about_z = SE3.exp([0, 0, 0, 0, 0, q[i] if i < 7 else 0.0])
        base_from_joint = (
            base_from_joint @ before @ about_z @ SE3.exp([0, 0, d[i], 0, 0, 0])
        )
    return base_from_joint


def test_panda_agrees_with_its_published_parameters() -> None:
    spec = pytest.importorskip("importlib.metadata")
    try:
        files = spec.files("example-robot-data") or []
    except spec.PackageNotFoundError:
        pytest.skip("example-robot-data is not installed")
    file = next(
        f for f in files if str(f).endswith("panda_description/urdf/panda.urdf")
    )
    model = RobotModel(Path(file.locate()))
    refused(
        r"has 3 ends; name the link with `gripper_frame`",
        model.chosen_links,
        None,
        None,
    )
    joints = model.arm("panda_link0", "panda_link8").joints
    assert joints == tuple(f"panda_joint{i}" for i in range(1, 8))
    q = np.random.default_rng(1).uniform(-1.5, 0.0, (20, 7))
    poses = model.poses(joints, q, "panda_link0", "panda_link8").poses
    for row, pose in zip(q, poses, strict=True):
        assert max(pose_distance(pose, panda_flange(row))) < 1e-6
    # The other way round, and from the hand, which is fixed to the flange.
    back = model.poses(joints, q, "panda_link8", "panda_link0").poses
    assert max(pose_distance(back, poses.inverse())[0]) < 1e-9


def test_folder_with_joints_and_a_urdf_is_a_recording(
    tmp_path: Path, urdf: Path
) -> None:
    for i in range(3):
        write_image(tmp_path / f"{i}.png", np.zeros((24, 32, 3), np.uint8))
    (tmp_path / "camera.txt").write_text("30 0 15.5\n0 30 11.5\n0 0 1\n")
    (tmp_path / "joints.csv").write_text(
        "image,elbow_deg,shoulder,reach_m\n2.png,90,0.5,0.1\n0.png,-30,0.25,0.2\n1.png,5,1,0\n"
    )
    refused("no URDF is beside it; give `urdf`", load_recording, tmp_path)
    options = ReadOptions(urdf=urdf)
    recording = load_recording(tmp_path, options=options)
    expected = [planar(0.25, np.deg2rad(-30), 0.2), planar(1, np.deg2rad(5), 0)]
    expected.append(planar(0.5, np.pi / 2, 0.1))
    for frame, pose in zip(recording.train, expected, strict=True):
        assert_pose(frame.base_from_gripper, pose)
    # Of the column that does not say.
    degrees = ReadOptions(urdf=urdf, pose_convention="deg")
    pose_in_degrees = (
        load_recording(tmp_path, options=degrees).train[0].base_from_gripper
    )
    assert pose_in_degrees is not None
    expected = planar(np.deg2rad(0.25), np.deg2rad(-30), 0.2)
    assert max(pose_distance(pose_in_degrees, expected)) < 1e-7
    assert (
        recording.notes[0] == "gripper poses are those of tip in base, from planar.urdf"
    )
    with pytest.raises(InputError, match="has no link 'hand'; it has base, upper"):
        load_recording(tmp_path, options=ReadOptions(urdf=urdf, gripper_frame="hand"))


def test_json_and_csv_agree(tmp_path: Path, model: RobotModel) -> None:
    names = ["shoulder", "elbow", "reach"]
    rows = [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]
    text = "stamp_s," + ",".join(names) + "\n"
    text += "".join(f"{i},{','.join(map(str, row))}\n" for i, row in enumerate(rows))
    (tmp_path / "joints.csv").write_text(text)
    data = {"joint_names": names, "positions": rows, "stamps_s": [0, 1]}
    (tmp_path / "joints.json").write_text(json.dumps(data))
    one, two = (
        read_joint_poses(tmp_path / f"joints.{k}", model)[0] for k in ("csv", "json")
    )
    assert one.stamps_s is not None
    assert two.stamps_s is not None
    assert one.stamps_s.tolist() == two.stamps_s.tolist() == [0, 1]
    np.testing.assert_allclose(one.poses.matrix(), two.poses.matrix())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("shoulder,elbow\n0,0\n", "no values for joint reach, which tip depends on"),
        ("shoulder,elbow,reach\n90,20,0\n", "joint shoulder is at 90.0.*shoulder_deg"),
        (
            "shoulder,elbow,reach,elbow_deg\n0,1,0,90\n",
            "'elbow' comes twice; keep one column of each joint",
        ),
        ("shoulder,elbow,reach\n0,x,0\n", "column 'elbow': 'x' is not a finite number"),
        ("shoulder,elbow,reach\n", "then rows of joint angles"),
    ],
)
def test_wrong_joint_tables_are_refused(
    tmp_path: Path, model: RobotModel, text: str, message: str
) -> None:
    file = tmp_path / "joints.csv"
    file.write_text(text)
    refused(message, read_joint_poses, file, model)


@pytest.mark.parametrize(
    "data",
    ["{", "[]", '{"joint_names": ["a"]}', '{"joint_names": ["a"], "positions": [[1, 2]]}',
     '{"joint_names": ["shoulder"], "positions": [[1]], "images": ["a", "b"]}'],
)  # fmt: skip
def test_wrong_json_is_refused(tmp_path: Path, model: RobotModel, data: str) -> None:
    (tmp_path / "joints.json").write_text(data)
    refused(r"joints\.json", read_joint_poses, tmp_path / "joints.json", model)


@pytest.mark.parametrize(
    ("rows", "note"),
    [
        ("3.5,9,0\n", "shoulder goes from 3.50 to 3.50, the URDF allows -3.00 to 3.00"),
        (
            "0,-170,0\n0,170,0\n",
            "elbow goes from -170.00 to 170.00, more than two rotations",
        ),
        ("0,100,0\n0,103,0\n", None),
    ],
)
def test_angles_beyond_the_limits_are_noted(
    tmp_path: Path, model: RobotModel, rows: str, note: str | None
) -> None:
    file = tmp_path / "joints.csv"
    file.write_text("shoulder,elbow,reach\n" + rows)
    _, notes = read_joint_poses(file, model)
    assert len(notes) == (1 if note is None else 2)
    assert note is None or note in notes[1]


def test_joints_are_not_interpolated_over_gaps() -> None:
    times = np.array([0.0, 0.1, 0.2, 9.0])
    angles = np.array([3.0, -3.0, -2.9, -1.0])  # turns on through pi
    values, valid = interpolate(
        times, angles, np.array([-0.1, 0.05, 0.2, 5.0, 9.0, 9.1])
    )
    assert valid.tolist() == [False, True, True, False, True, False]
    assert values[1] == pytest.approx((3.0 + (2 * np.pi - 3.0)) / 2)


def test_other_files_are_refused(tmp_path: Path) -> None:
    for name, text in (("a.urdf", "<robot"), ("b.urdf", "<house/>"), ("c.urdf", "")):
        (tmp_path / name).write_text(text)
        refused(f"{name}: no usable URDF", RobotModel, tmp_path / name)
    refused("no such URDF", RobotModel, tmp_path / "d.urdf")
    (tmp_path / "e.urdf.xacro").write_text("")
    refused("'xacro' first", RobotModel, tmp_path / "e.urdf.xacro")
