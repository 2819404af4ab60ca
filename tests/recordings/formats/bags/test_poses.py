"""Where the gripper was at the images of a bag: from tf, or from joint states and a URDF."""

import dataclasses
import math
from pathlib import Path

import pytest

from evercal.geometry import SE3
from evercal.recordings import ReadOptions, load_recording

pytest.importorskip("rosbags", reason="the extra 'bags' is not installed")

from ...checks import assert_pose
from ..bags_of_messages import (
    BASE_FROM_SHOULDER,
    SHOTS,
    TOOL_FROM_OPTICAL,
    WORLD_FROM_BASE,
    Bag,
    picture,
    recorded_bag,
    refusal,
    refusal_of,
    shoulder_from_tool,
    single,
)

TURNING = (
    '<robot name="a"><link name="base"/><link name="tip"/>'
    '<joint name="turn" type="continuous"><parent link="base"/><child link="tip"/>'
    '<origin xyz="1 0 0"/><axis xyz="0 0 1"/></joint></robot>'
)


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    """A link that turns by one joint."""
    (tmp_path / "arm.urdf").write_text(TURNING)
    return tmp_path / "arm.urdf"


def turned(angle: float) -> SE3:
    """base_from_tip."""
    return SE3.exp([1, 0, 0, 0, 0, 0]) @ SE3.exp([0, 0, 0, 0, 0, angle])


def test_frames_can_be_chosen(tmp_path: Path) -> None:
    path = recorded_bag().write(tmp_path)
    options = ReadOptions(base_frame="/shoulder", gripper_frame="camera_optical")
    recording = load_recording(path, options=options)
    for frame, at in zip(recording.train, SHOTS, strict=False):
        assert frame.base_from_gripper is None
        expected = shoulder_from_tool(at) @ TOOL_FROM_OPTICAL
        assert_pose(frame.base_from_camera, expected, 1e-7)
    # The other way round, through the shared ancestor of two side branches.
    options = ReadOptions(base_frame="camera_optical", gripper_frame="world")
    first = load_recording(path, options=options).train[0]
    base_from_optical = BASE_FROM_SHOULDER @ shoulder_from_tool(0) @ TOOL_FROM_OPTICAL
    expected = (WORLD_FROM_BASE @ base_from_optical).inverse()
    assert_pose(first.base_from_gripper, expected, 1e-7)


def test_poses_of_a_still_arm_cover_long_gaps(tmp_path: Path) -> None:
    bag = Bag("sqlite3")
    bag.tf(0.0, "base_link", "shoulder", BASE_FROM_SHOULDER, static=True)
    # Stands for 3 s at two places; on the way nothing is recorded.
    for at, progress in ((0.0, 0.1), (3.0, 0.1), (6.0, 0.9), (9.0, 0.9)):
        bag.tf(at, "shoulder", "tool0", shoulder_from_tool(progress))
    for at in (1.0, 4.5, 7.0):
        bag.image(at, "/cam/image_raw", picture(0))
    bag.info()
    recording = load_recording(bag.write(tmp_path))
    assert [frame.name for frame in recording.train] == ["000000", "000002"]
    assert recording.untracked == 1


def test_joint_states_with_a_urdf_replace_tf(tmp_path: Path, urdf: Path) -> None:
    bag = Bag("ros1")
    for i in range(21):
        bag.joints(i / 10, {"finger": 0.0, "turn": i / 10, "wheel": math.nan})
    for at in (0.25, 1.99, 2.3):
        bag.image(at, "/cam/image_raw", picture(0))
    bag.info()
    path = bag.write(tmp_path)
    recording = load_recording(path, options=ReadOptions(urdf=urdf))
    assert recording.untracked == 1
    for frame, at in zip(recording.train, (0.25, 1.99), strict=True):
        assert_pose(frame.base_from_gripper, turned(at), 1e-7)
    whole = load_recording(path, options=ReadOptions(urdf=urdf, whole_robot=True))
    assert whole.untracked == 1
    assert whole.arm
    assert whole.arm.joints == ("turn",)
    assert whole.train[0].joints_rad == pytest.approx((0.25,))
    message = "so there are no gripper poses; record /tf and /tf_static, or give the robot's `urdf`"
    assert f"{message} for /joint_states" in refusal_of(path)
    urdf.write_text(TURNING.replace('"turn"', '"wheel"'))
    message = "no values for joint wheel, which tip depends on; given are finger, turn"
    assert message in refusal_of(path, urdf=urdf)


def test_joint_on_several_topics_needs_a_pose_topic(tmp_path: Path, urdf: Path) -> None:
    bag = Bag("mcap")
    for i in range(21):
        bag.joints(i / 10, {"turn": i / 10})
        bag.joints(i / 10 + 0.05, {"turn": i / 10 + 0.5}, "/joint_states_desired")
        bag.joints(i / 10, {"finger": 0.0}, "/hand/joint_states")  # of no concern
    bag.image(1.0, "/cam/image_raw", picture(0))
    bag.info()
    path = bag.write(tmp_path)
    message = "turn is on several topics, /joint_states, /joint_states_desired; choose one with `po"
    assert message in refusal_of(path, urdf=urdf)
    options = ReadOptions(urdf=urdf, pose_topic="/joint_states")
    pose = load_recording(path, options=options).train[0].base_from_gripper
    assert_pose(pose, turned(1.0), 1e-7)
    message = "no joint states on topic '/tf'; joint states are on /hand/"
    assert message in refusal_of(path, urdf=urdf, pose_topic="/tf")


def test_frame_on_several_topics_needs_a_pose_topic(tmp_path: Path) -> None:
    bag = recorded_bag()
    # Agrees.
    bag.tf(0.0, "base_link", "shoulder", BASE_FROM_SHOULDER, static=True, robot="/left")
    bag.tf(0.0, "tool0", "finger", SE3.identity(), static=True)
    bag.tf(0.0, "tool0", "finger", turned(0.0), static=True, robot="/left")
    path = bag.write(tmp_path / "static")
    assert len(load_recording(path).train) == 6
    several = "is on several topics, /left/tf, /tf; choose one with `pose_topic`"
    assert f"tool0 -> finger {several}" in refusal_of(path, gripper_frame="finger")
    for i in range(51):
        late = shoulder_from_tool(i / 25 + 0.3)
        bag.tf(i / 25, "shoulder", "tool0", late, robot="/left")
    path = bag.write(tmp_path / "moving")
    assert f"tf shoulder -> tool0 {several}" in refusal_of(path)
    for topic, late in (("/tf", 0.0), ("/left/tf", 0.3)):
        recording = load_recording(path, options=ReadOptions(pose_topic=topic))
        pose = recording.train[0].base_from_gripper
        assert_pose(pose, BASE_FROM_SHOULDER @ shoulder_from_tool(late), 1e-7)
    message = "no transforms on topic '/right/tf'; transforms are on /left/tf, /tf"
    assert message in refusal_of(path, pose_topic="/right/tf")


def test_ambiguous_frames_are_refused(tmp_path: Path) -> None:
    bag = recorded_bag()
    path = bag.write(tmp_path)
    message = "`base_frame` table: no such frame in tf; it has world, base_link"
    assert message in refusal_of(path, base_frame="table")
    message = "`gripper_frame` hand: no such frame"
    assert message in refusal_of(path, gripper_frame="hand")
    bag.tf(0.0, "base_link", "base", SE3.identity(), static=True)
    message = "`base_frame` (it may be base_link or base); tf has"
    assert message in refusal(bag, tmp_path / "ur")
    odd = Bag("mcap")
    odd.tf(0.0, "map", "phone", SE3.identity())
    odd.image(0.0, "/cam/image_raw", picture(0))
    odd.info("/cam/camera_info")
    message = "`base_frame` (no frame has a usual name); tf has map, phone"
    assert message in refusal(odd, tmp_path / "odd")


def test_broken_trees_of_frames_are_refused(tmp_path: Path) -> None:
    for name, parent, child, message in (
        (
            "apart",
            "elsewhere",
            "flange",
            "tf has no chain between 'base_link' and 'flange'",
        ),
        ("circle", "camera_optical", "world", "tf has a cycle"),
        (
            "two",
            "world",
            "tool0",
            "tf frame 'tool0' has several parents, shoulder, world",
        ),
    ):
        bag = recorded_bag()
        bag.tf(0.1, parent, child, SE3.identity())
        gripper = "flange" if name == "apart" else "tool0"
        assert message in refusal(bag, tmp_path / name, gripper_frame=gripper)
    bag = recorded_bag()
    transforms = bag.messages[0][3].transforms
    nothing = bag.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=0.0)
    transform = dataclasses.replace(transforms[0].transform, rotation=nothing)
    transforms[0] = dataclasses.replace(transforms[0], transform=transform)
    assert "no rigid transform; repair the program" in refusal(bag, tmp_path / "zero")


def test_images_of_another_clock_are_refused(tmp_path: Path) -> None:
    message = refusal(single(at=3600.0), tmp_path)
    assert "no image has a pose" in message
    assert "tf covers -3600.0 to -3598.0 s; are the clocks the same?" in message
