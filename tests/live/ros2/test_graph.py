"""Cameras and arms of ROS 2 graphs, whose publishers are other processes without evercal."""

import time

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from evercal.errors import InputError
from evercal.live.robot import TimedRobot
from evercal.live.ros2 import robot as ros2_robot
from evercal.live.ros2.robot import Ros2Robot
from evercal.live.sources import open_camera, open_robot
from evercal.robot.frame_names import FrameNames

from .graphs import driver, environment, tell

RAW = "ros2:/camera/image_raw"


@pytest.fixture(autouse=True)
def on_loopback(monkeypatch):
    in_new_domain(monkeypatch)


def in_new_domain(monkeypatch):
    for name, value in environment().items():
        monkeypatch.setenv(name, value)


@pytest.mark.parametrize("reliability", ["reliable", "best_effort"])
@pytest.mark.parametrize("kind", ["raw", "compressed"])
def test_images_of_every_kind_with_their_intrinsics(kind, reliability):
    with driver("camera", kind, reliability, "320x240") as process:
        source = RAW if kind == "raw" else f"{RAW}/compressed"
        camera = open_camera(source)
        tell(process, 90)
        time.sleep(0.3)
        stamp, image = camera.read()
        assert abs(time.time() - stamp) < 2
        assert image.shape == (240, 320, 3)
        np.testing.assert_allclose(image[0, 0], (200, 100, 50), atol=3)
        np.testing.assert_allclose(image[-1, -1], 90, atol=3)
        own = camera.intrinsics()
        assert own is not None
        assert (own.fx, own.cx, own.width) == (320, 160, 320)
        assert own.distortion[:2] == (0.1, -0.2)
        assert camera.frame_id == "wrist_optical"


def test_images_of_three_megabytes_arrive_whole():
    with driver("camera", "raw", "reliable", "1280x720"):
        camera = open_camera(RAW)
        times = []
        for _ in range(3):
            stamp, image = camera.read()
            times.append(stamp)
            assert image.shape == (720, 1280, 3)
            assert (image[:, :640] == (200, 100, 50)).all()
            assert not image[:, 640:].any()
        assert times == sorted(set(times))


def test_the_gripper_is_where_tf_has_it_now_and_at_a_time(monkeypatch):
    with driver("arm") as process:
        time.sleep(0.3)  # tf_static is from before
        robot = open_robot("ros2:")
        pose = robot.base_from_gripper()
        np.testing.assert_allclose(pose.translation_m, (0.5, 0, 0.6))
        tell(process, 0.4)
        time.sleep(0.2)
        moved = robot.base_from_gripper()
        np.testing.assert_allclose(moved.translation_m, (0.5, 0.4, 0.6))
        np.testing.assert_allclose(moved.rotation.as_rotvec(), (0, 0, 0.4))
        assert isinstance(robot, Ros2Robot)
        assert robot.frames == FrameNames("base_link", "tool0")
        assert isinstance(robot, TimedRobot)
        before = robot.at(time.time())
        np.testing.assert_allclose(before.translation_m, moved.translation_m)
        monkeypatch.setattr("evercal.live.ros2.robot.FIND_S", 0.2)
        with pytest.raises(InputError, match="clocks"):
            robot.at(time.time() - 100)


def test_frames_that_are_not_there(monkeypatch):
    monkeypatch.setattr("evercal.live.ros2.robot.FIND_S", 0.5)
    with driver("arm"):
        robot = open_robot("ros2:", FrameNames("world", "tool0"))
        with pytest.raises(
            InputError, match=r"`base_frame` world.* base_link, shoulder"
        ):
            robot.base_from_gripper()


def test_a_camera_or_an_arm_that_is_gone(monkeypatch):
    monkeypatch.setattr("evercal.live.ros2.robot.FIND_S", 0.5)
    with driver("arm"):
        with driver("camera", "raw", "best_effort", "64x48"):
            camera = open_camera(RAW, timeout_s=0.5)
            camera.read()
        with pytest.raises(InputError, match="no more frames"):
            camera.read()
        robot = open_robot("ros2:")
        robot.base_from_gripper()
    with pytest.raises(
        InputError, match="no pose of tool0 in base_link arrives any more"
    ):
        robot.base_from_gripper()


def test_another_domain_and_another_type(monkeypatch):
    monkeypatch.setattr("evercal.live.ros2.graph.FIND_S", 0.5)
    with driver("camera", "raw", "best_effort", "64x48"):
        assert open_camera(RAW).read()[1].shape == (48, 64, 3)
        with pytest.raises(InputError, match="but on /camera/image_raw"):
            open_camera("ros2:/camera/camera_info")
        in_new_domain(monkeypatch)
        with pytest.raises(InputError, match=r"no sensor_msgs/msg/Image"):
            open_camera(RAW)


@pytest.mark.parametrize("domain", ["300", "home"])
def test_a_domain_that_is_none(monkeypatch, domain):
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(InputError, match=f"ROS_DOMAIN_ID {domain}: give a number"):
        open_camera(RAW)


def test_a_graph_without_an_arm(monkeypatch):
    in_new_domain(monkeypatch)
    monkeypatch.setattr(ros2_robot, "FIND_S", 0.3)
    with pytest.raises(InputError, match="ros2:/tf: nothing arrives"):
        Ros2Robot().base_from_gripper()
