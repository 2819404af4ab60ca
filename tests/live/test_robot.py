"""Robots by a file that grows."""

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.live.robot import PoseFileRobot

HEADER = "stamp_s,x,y,z,qw,qx,qy,qz\n"


def poses(count: int) -> SE3:
    rng = np.random.default_rng(3)
    return SE3.exp(rng.normal(scale=0.4, size=(count, 6)))


def row(i: int, pose: SE3) -> str:
    return ",".join(map(str, [i, *pose.translation_m, *pose.rotation_wxyz])) + "\n"


def assert_same(a: SE3, b: SE3) -> None:
    assert max(pose_distance(a, b)) < 1e-6


def test_the_last_complete_row_wins_at_every_byte(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    three = poses(2)
    header = f"# written by a program\n#{HEADER}"
    rows = [row(i, pose) for i, pose in enumerate(three)]
    whole = header + "".join(rows)
    robot = PoseFileRobot(path)
    ends = np.cumsum([len(header), *map(len, rows)])
    for length in range(ends[1], len(whole) + 1):
        path.write_text(whole[:length])
        complete = int(np.searchsorted(ends, length, side="right")) - 2
        assert_same(robot.base_from_gripper(), three[complete])


def test_json_lines(tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    two = poses(2)
    entries = [
        json.dumps(
            {
                "stamp_s": i,
                "translation_m": pose.translation_m.tolist(),
                "quaternion_wxyz": pose.rotation_wxyz.tolist(),
            }
        )
        for i, pose in enumerate(two)
    ]
    path.write_text(entries[0] + "\n" + entries[1][:40])
    assert_same(PoseFileRobot(path).base_from_gripper(), two[0])
    path.write_text("\n".join(entries) + "\n")
    assert_same(PoseFileRobot(path).base_from_gripper(), two[1])


def test_a_long_file_without_header_in_a_robots_convention(tmp_path: Path) -> None:
    path = tmp_path / "kuka.txt"
    lines = [f"{400 + i / 10:.3f} 0 300 0 0 {i % 90}\n" for i in range(20000)]
    path.write_text("".join(lines))
    last = PoseFileRobot(path, "kuka").base_from_gripper()
    np.testing.assert_allclose(last.translation_m, [0.4 + 19999e-4, 0, 0.3], atol=1e-9)


def test_bad_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    robot = PoseFileRobot(path, most_age_s=60.0)
    for text, words in (
        (None, "missing"),
        ("", "no complete line"),
        (HEADER, "no line of num"),
    ):
        if text is not None:
            path.write_text(text)
        with pytest.raises(InputError, match=words) as error:
            robot.base_from_gripper()
        assert str(path) in str(error.value)
    path.write_text(HEADER + row(0, poses(1)[0]))
    robot.base_from_gripper()
    os.utime(path, (1e9, 1e9))
    with pytest.raises(InputError, match="last written"):
        robot.base_from_gripper()
    ahead = time.time() + 3600
    os.utime(path, (ahead, ahead))
    with pytest.raises(InputError, match=r"written 3[56]\d\d\.\d s in the future; set"):
        robot.base_from_gripper()
    PoseFileRobot(path).base_from_gripper()
