"""Where the gripper was at the images of a bag: from tf, or from joint states and a URDF."""

import dataclasses
from pathlib import Path

import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.recordings import ReadOptions, load_recording

pytest.importorskip("rosbags", reason="the extra 'bags' is not installed")

from ...checks import assert_pose, refused
from ..bags_of_messages import (
    BASE_FROM_SHOULDER,
    SHOTS,
    TOOL_FROM_OPTICAL,
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


def test_frames_can_be_chosen(tmp_path: Path) -> None:
    path = recorded_bag("mcap").write(tmp_path)
    options = ReadOptions(base_frame="/shoulder", gripper_frame="camera_optical")
    recording = load_recording(path, options=options)
    for frame, at in zip(recording.train, SHOTS, strict=False):
        assert frame.base_from_gripper is None
        assert frame.base_from_camera is not None
        expected = shoulder_from_tool(at) @ TOOL_FROM_OPTICAL
        assert max(pose_distance(frame.base_from_camera, expected)) < 1e-7
    # The other way round, through the shared ancestor of two side branches.
    options = ReadOptions(base_frame="camera_optical", gripper_frame="world")
    optical_from_world = (
        load_recording(path, options=options).train[0].base_from_gripper
    )
    world_from_base = SE3.exp([9.0, 9.0, 9.0, 1.0, 0.0, 0.0])
    base_from_optical = BASE_FROM_SHOULDER @ shoulder_from_tool(0) @ TOOL_FROM_OPTICAL
    assert optical_from_world is not None
    expected = (world_from_base @ base_from_optical).inverse()
    assert max(pose_distance(optical_from_world, expected)) < 1e-7


def test_poses_of_a_still_arm_cover_long_gaps(tmp_path: Path) -> None:
    bag = Bag("sqlite3")
    bag.tf(0.0, "base_link", "shoulder", BASE_FROM_SHOULDER, static=True)
    # Stands for 3 s at two places; on the way nothing is recorded.
    for at, progress in ((0.0, 0.1), (3.0, 0.1), (6.0, 0.9), (9.0, 0.9)):
        bag.tf(at, "shoulder", "tool0", shoulder_from_tool(progress))
    for at in (1.0, 4.5, 7.0):
        bag.image(at, "/cam/image_raw", picture(0))
    bag.info("/cam/camera_info")
    recording = load_recording(bag.write(tmp_path))
    assert [frame.name for frame in recording.train] == ["000000", "000002"]
    assert recording.untracked == 1


def test_joint_states_with_a_urdf_replace_tf(tmp_path: Path) -> None:
    pytest.importorskip("yourdfpy", reason="the extra 'urdf' is not installed")
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(TURNING)
    bag = Bag("ros1")
    for i in range(21):
        bag.joints(i / 10, {"finger": 0.0, "turn": i / 10})
    for at in (0.25, 1.99, 2.3):
        bag.image(at, "/cam/image_raw", picture(0))
    bag.info("/cam/camera_info")
    path = bag.write(tmp_path)
    recording = load_recording(path, options=ReadOptions(urdf=urdf))
    assert recording.untracked == 1
    for frame, at in zip(recording.train, (0.25, 1.99), strict=True):
        assert frame.base_from_gripper is not None
        expected = SE3.exp([1, 0, 0, 0, 0, 0]) @ SE3.exp([0, 0, 0, 0, 0, at])
        assert max(pose_distance(frame.base_from_gripper, expected)) < 1e-7
    refused(
        r"no tf in it.*give the robot's `urdf` for /joint_states", load_recording, path
    )
    urdf.write_text(urdf.read_text().replace('"turn"', '"wheel"'))
    with pytest.raises(
        InputError, match=r"no values for joint wheel, .* given are finger, turn"
    ):
        load_recording(path, options=ReadOptions(urdf=urdf))


def test_joint_on_several_topics_needs_a_pose_topic(tmp_path: Path) -> None:
    pytest.importorskip("yourdfpy", reason="the extra 'urdf' is not installed")
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(TURNING)
    bag = Bag("mcap")
    for i in range(21):
        bag.joints(i / 10, {"turn": i / 10})
        bag.joints(i / 10 + 0.05, {"turn": i / 10 + 0.5}, "/joint_states_desired")
        bag.joints(i / 10, {"finger": 0.0}, "/hand/joint_states")  # of no concern
    bag.image(1.0, "/cam/image_raw", picture(0))
    bag.info("/cam/camera_info")
    assert (
        "joint turn is on several topics, /joint_states, /joint_states_desired; choose one with"
        " `pose_topic`"
    ) in refusal(bag, tmp_path, urdf=urdf)
    path = tmp_path / "wave"
    recording = load_recording(
        path, options=ReadOptions(urdf=urdf, pose_topic="/joint_states")
    )
    pose = recording.train[0].base_from_gripper
    assert_pose(pose, SE3.exp([1, 0, 0, 0, 0, 0]) @ SE3.exp([0] * 5 + [1.0]), 1e-7)
    with pytest.raises(
        InputError, match="no joint states on topic '/tf'; joint states are on /hand/"
    ):
        load_recording(path, options=ReadOptions(urdf=urdf, pose_topic="/tf"))


def test_frame_on_several_topics_needs_a_pose_topic(tmp_path: Path) -> None:
    bag = recorded_bag("mcap")
    # Agrees.
    bag.tf(0.0, "base_link", "shoulder", BASE_FROM_SHOULDER, static=True, robot="/left")
    bag.tf(0.0, "tool0", "finger", SE3.identity(), static=True)
    bag.tf(
        0.0, "tool0", "finger", SE3.exp([1, 0, 0, 0, 0, 0]), static=True, robot="/left"
    )
    assert len(load_recording(bag.write(tmp_path / "static")).train) == 6
    expected_message = (
        "tf tool0 -> finger is on several topics, /left/tf, /tf; choose one"
    )
    assert expected_message in refusal_of(
        tmp_path / "static/wave", gripper_frame="finger"
    )
    for i in range(51):
        bag.tf(
            i / 25, "shoulder", "tool0", shoulder_from_tool(i / 25 + 0.3), robot="/left"
        )
    expected_message = (
        "tf shoulder -> tool0 is on several topics, /left/tf, /tf; choose one"
    )
    assert expected_message in refusal(bag, tmp_path / "moving")
    for topic, late in (("/tf", 0.0), ("/left/tf", 0.3)):
        recording = load_recording(
            tmp_path / "moving/wave", options=ReadOptions(pose_topic=topic)
        )
        pose = recording.train[0].base_from_gripper
        assert_pose(pose, BASE_FROM_SHOULDER @ shoulder_from_tool(late), 1e-7)
    expected_message = (
        "no transforms on topic '/right/tf'; transforms are on /left/tf, /tf"
    )
    assert expected_message in refusal_of(
        tmp_path / "moving/wave", pose_topic="/right/tf"
    )


def test_ambiguous_frames_are_refused(tmp_path: Path) -> None:
    bag = recorded_bag("mcap")
    path = bag.write(tmp_path)
    message = "`base_frame` table: no such frame in tf; it has world, base_link"
    assert message in refusal_of(path, base_frame="table")
    assert "`gripper_frame` hand: no such frame" in refusal_of(
        path, gripper_frame="hand"
    )
    bag.tf(0.0, "base_link", "base", SE3.identity(), static=True)
    assert "`base_frame` (it may be base_link or base); tf has" in refusal(
        bag, tmp_path / "ur"
    )
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
        bag = recorded_bag("mcap")
        bag.tf(0.1, parent, child, SE3.identity())
        gripper = "flange" if name == "apart" else "tool0"
        assert message in refusal(bag, tmp_path / name, gripper_frame=gripper)
    bag = recorded_bag("mcap")
    nothing = bag.messages[0][3].transforms[0]
    zero = bag.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=0.0)
    transform = dataclasses.replace(nothing.transform, rotation=zero)
    bag.messages[0][3].transforms[0] = dataclasses.replace(nothing, transform=transform)
    assert "no rigid transform; repair the program" in refusal(bag, tmp_path / "zero")


def test_images_of_another_clock_are_refused(tmp_path: Path) -> None:
    message = refusal(single(at=3600.0), tmp_path)
    assert "no image has a pose" in message
    assert "tf covers -3600.0 to -3598.0 s; are the clocks the same?" in message
