"""`evercal solve` of fixed cameras without motions of the robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.calibration.calibration import read_calibration
from evercal.geometry import SE3
from evercal.recordings import write_image

from ..calibration.fixed.test_place_and_rig import GRID, board_file, seen_at, tables

TRUTH = SE3.exp([0.5, 0.1, 0.8, 0, 0, 0]) @ SE3.exp([0, 0, 0, 2.6, 0.1, 0.2])


def positions(folder: Path, header: str) -> list[Any]:
    """Tables of one point in the base and in the camera frame."""
    seen = np.random.default_rng(0).uniform([-0.2, -0.15, 0.6], [0.2, 0.15, 1], (20, 3))
    for name, values in (("robot", TRUTH.apply(seen)), ("camera", seen)):
        rows = [",".join(f"{value:.7f}" for value in row) for row in values]
        (folder / f"{name}.csv").write_text("\n".join([header, *rows]) + "\n")
    tables = ["--robot-poses", folder / "robot.csv", "--camera-poses"]
    return ["solve", *tables, folder / "camera.csv", "--out", folder / "out.json"]


def test_positions_of_robot_and_camera_calibrate_a_fixed_camera(run, tmp_path):
    words = positions(tmp_path, "x,y,z")
    ran = run(*words, "--mount eye_to_hand")
    assert ran.code == 0
    assert "left open    whether the camera sees the very point" in ran.out
    found = read_calibration(tmp_path / "out.json")
    assert found.uncertain_pose.squared_mahalanobis(TRUTH) < 12.6
    message = run.refused(*words, "--mount eye_in_hand")
    assert "positions without rotations" in message
    assert "eye_to_hand" in message
    assert "--mount: give" in run.refused(*words)
    poses = tables(tmp_path, {"left": range(20)})[0]
    words[2] = poses
    assert "positions without rotations" in run.refused(*words, "--mount eye_to_hand")


def test_touched_points_are_picked_in_an_image(run, tmp_path):
    rng = np.random.default_rng(1)
    seen = rng.uniform([-0.2, -0.15, 0.7], [0.2, 0.15, 1], (9, 3))
    base = TRUTH.apply(seen)
    pixels = 620 * seen[:, :2] / seen[:, 2:] + [319.5, 239.5]
    touched = ["name,x,y,z"]
    picks = ["image,name,u,v"]
    for i, (point, (u, v)) in enumerate(zip(base, pixels, strict=True)):
        touched.append(f"p{i}," + ",".join(f"{value:.6f}" for value in point))
        picks.append(f"a.png,p{i},{u:.2f},{v:.2f}")
    (tmp_path / "points.csv").write_text("\n".join(touched))
    (tmp_path / "picks.csv").write_text("\n".join(picks))
    write_image(tmp_path / "a.png", np.zeros((480, 640, 3), np.uint8))
    (tmp_path / "camera.txt").write_text("620 0 319.5\n0 620 239.5\n0 0 1\n")
    out = tmp_path / "out.json"
    words = ["solve", "--points", tmp_path / "points.csv", "--out", out]
    more = ["--picks", tmp_path / "picks.csv", "--camera", tmp_path / "camera.txt"]
    assert run(*words, *more).code == 0
    found = read_calibration(out)
    assert found.uncertain_pose.squared_mahalanobis(TRUTH) < 12.6
    assert "--picks" in run.refused(*words)
    assert "three ways" in run.refused(*words, "--board-at", "0,0,0,1,0,0,0")


def test_a_board_at_a_known_place_and_several_cameras(run, tmp_path):
    out = tmp_path / "out.json"
    board = board_file(tmp_path / "left.json", GRID, [seen_at(1)], 0.1)
    words = ["solve", "--out", out, "--camera-poses", board]
    ran = run(*words, "--board-at", "0.5,0.1,0.02,1,0,0,0")
    assert "turned by 90 or 180 deg" in ran.out
    assert read_calibration(out).on_gripper is False
    refused = run.refused(*words, "--board-at 0.5,0,0,1,0,0,0 --mount eye_in_hand")
    assert "--robot-poses" in refused
    assert "one camera alone" in run.refused(*words)
    assert "give --camera-poses" in run.refused("solve", "--out", out)


@pytest.mark.parametrize("names", ["{:03d}.png", ""])
def test_cameras_of_one_moving_board_are_exported(run, tmp_path, names):
    out = tmp_path / "rig.json"
    files = tables(tmp_path, {"left": range(10), "right": range(10)}, names)
    ran = run("solve", "--out", out, "--camera-poses", *files)
    assert ran.code == 0
    assert "left_from_right: " in ran.out
    assert "10 moments in common" in ran.out
    exported = run("export", f"{out}:right", "--format csv")
    assert exported.code == 0
    assert "not 'front'" in run.refused("export", f"{out}:front", "--format csv")
