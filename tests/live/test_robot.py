"""Robots by a file that grows."""

import json
import os
import time

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance, pose_to_dict
from evercal.live.camera import StreamCamera
from evercal.live.robot import PoseFileRobot
from evercal.live.sources import open_robot
from evercal.robot.frame_names import FrameNames
from evercal.service.studio.devices import Connection, Devices

HEADER = "stamp_s,x,y,z,qw,qx,qy,qz\n"


def poses(count):
    rng = np.random.default_rng(3)
    return SE3.exp(rng.normal(scale=0.4, size=(count, 6)))


def row(i, pose):
    return ",".join(map(str, [i, *pose.translation_m, *pose.rotation_wxyz])) + "\n"


def assert_same(a, b):
    assert max(pose_distance(a, b)) < 1e-6


def test_the_last_complete_row_wins_at_every_byte(tmp_path):
    path = tmp_path / "poses.csv"
    two = poses(2)
    start = f"# written by a program\n#{HEADER}{row(0, two[0])}"
    whole = start + row(1, two[1])
    robot = PoseFileRobot(path)
    for length in range(len(start), len(whole) + 1):
        path.write_text(whole[:length])
        assert_same(robot.base_from_gripper(), two[int(length == len(whole))])


def test_json_lines(tmp_path):
    path = tmp_path / "poses.jsonl"
    two = poses(2)
    entries = [
        json.dumps({"stamp_s": i, **(pose_to_dict(pose) or {})})
        for i, pose in enumerate(two)
    ]
    robot = PoseFileRobot(path)
    path.write_text("\n".join(entries)[:-9])
    assert_same(robot.base_from_gripper(), two[0])
    path.write_text("\n".join([*entries, ""]))
    assert_same(robot.base_from_gripper(), two[1])


def test_a_long_file_without_header_in_a_robots_convention(tmp_path):
    path = tmp_path / "kuka.txt"
    lines = [f"{400 + i / 10:.3f} 0 300 0 0 {i % 90}\n" for i in range(20000)]
    path.write_text("".join(lines))
    last = PoseFileRobot(path, "kuka").base_from_gripper()
    np.testing.assert_allclose(last.translation_m, [0.4 + 19999e-4, 0, 0.3], atol=1e-9)


def test_bad_files_are_named(tmp_path):
    path = tmp_path / "poses.csv"
    robot = PoseFileRobot(path, most_age_s=60.0)

    def refused(words):
        with pytest.raises(InputError, match=rf"{path}.*{words}"):
            robot.base_from_gripper()

    refused("missing")
    path.write_text("")
    refused("no complete line")
    path.write_text(HEADER)
    refused("no line of num")
    path.write_text(HEADER + row(0, poses(1)[0]))
    robot.base_from_gripper()
    os.utime(path, (1e9, 1e9))
    refused("last written")
    ahead = time.time() + 3600
    os.utime(path, (ahead, ahead))
    refused(r"written 3[56]\d\d\.\d s in the future; set")
    PoseFileRobot(path).base_from_gripper()


def test_names_that_were_given_are_kept_beside_a_file(tmp_path):
    names = FrameNames("base_link", "tool0", "wrist_optical")
    robot = open_robot(tmp_path / "poses.csv", names)
    camera = StreamCamera(str(tmp_path))
    intrinsics = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
    devices = Devices(camera, intrinsics, robot, fixed_camera=camera)
    connection = Connection(devices)
    assert connection.frames("wrist") == names
    assert connection.frames("fixed") == FrameNames("base_link", "tool0")
