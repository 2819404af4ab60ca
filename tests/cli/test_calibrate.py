"""`calibrate`, `check`, `audit` and `align`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from evercal.calibration.calibration import read_calibration
from evercal.cli.args import next_words
from evercal.errors import with_options
from evercal.geometry import SE3, pose_distance
from evercal.recordings import write_image
from evercal.robot.frame_names import FrameNames

if TYPE_CHECKING:
    from evercal.recordings import Frame

CHECK_KEYS = "moved translation_mm rotation_deg sigma_mm sigma_deg confidence same_map"
CHECK_KEYS += " reference_from_now images left_out note"


def printed(file: Path) -> Any:
    """A calibration file as the command line prints it, with options."""
    return json.loads(with_options(file.read_text()))


def truth_of(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


def test_folder_of_images_is_calibrated_and_checked(
    run, hall_store, four_images, hall, tmp_path
):
    out = tmp_path / "calibration.json"
    ran = run("calibrate", hall_store, four_images, "--out", out)
    assert ran.code == 0, ran.err
    first = ran.out.splitlines()[0]
    assert first.startswith("base_from_camera: the pose of camera in base")
    assert first.endswith("; scene hall")
    assert "4 of 4 used" in ran.out
    assert ran.out.splitlines()[-1].startswith(
        f"next: evercal verify {out} IMAGE... --pick"
    )
    tested = replace(read_calibration(out), verifications=({},))
    words = "--parent BASE --child CAMERA --robot-frame GRIPPER"
    assert next_words(tested, out)[4:] == words.split()
    estimate = read_calibration(out)
    assert pose_distance(estimate.parent_from_child, truth_of(hall.test[3]))[0] < 0.004
    assert estimate.source["store"] == str(hall_store)
    still = run("check", hall_store, four_images, "--reference", out, "--json")
    assert still.code == 0
    assert still.json.keys() == set(CHECK_KEYS.split())
    assert still.json["images"] == 4
    write_image(tmp_path / "moved.png", hall.test[6].read_image())
    moved = run("check", hall_store, tmp_path / "moved.png", "--reference", out)
    assert moved.code == 1
    assert moved.out.startswith("The camera has moved by ")
    assert moved.out.splitlines()[-1].startswith("next: evercal calibrate ")


def test_frames_of_a_calibration_are_named(run, hall_store, four_images, tmp_path):
    words = ("calibrate", hall_store, four_images, "--out", tmp_path / "c.json")
    ran = run(*words, "--base-frame base_link --camera-frame optical")
    assert ran.out.startswith("base_link_from_optical: ")
    assert read_calibration(tmp_path / "c.json").frames == FrameNames(
        "base_link", camera="optical"
    )
    tested = replace(read_calibration(tmp_path / "c.json"), verifications=({},))
    assert next_words(tested, "c.json")[-2:] == ["--robot-frame", "GRIPPER"]
    launch = tmp_path / "c.launch.py"
    export = ("export", tmp_path / "c.json", "--format launch_py --out", launch)
    assert run(*export).code == 0
    twice = run.refused(*words, "--base-frame a --camera-frame a")
    assert "both called 'a'; rename one of them (--camera-frame, or" in twice
    rig = ("calibrate", hall_store, f"left={four_images}", "--camera-frame a")
    assert "--camera-frame: is of one camera" in run.refused(*rig)


def test_cameras_of_a_rig(run, hall_store, four_images, hall, tmp_path):
    (tmp_path / "right").mkdir()
    write_image(tmp_path / "right" / "0.png", hall.test[6].read_image())
    words = (
        "calibrate",
        hall_store,
        f"left={four_images}",
        f"right={tmp_path / 'right'}",
    )
    ran = run(*words, "--out", tmp_path / "rig.json", "--json")
    assert ran.code == 0, ran.err
    assert ran.json == printed(tmp_path / "rig.json")
    left_from_right = truth_of(hall.test[3]).inverse() @ truth_of(hall.test[6])
    text = run(*words, "--out", tmp_path / "rig.json", "--at 0,0,1").out
    assert text.count("mm at (0, 0, 1) m in the camera frame") == 2
    line = next(
        line for line in text.splitlines() if line.startswith("left_from_right: ")
    )
    estimate = [float(word) for word in line.split()[1:4]]
    np.testing.assert_allclose(estimate, 1000 * left_from_right.translation_m, atol=6)


def test_point_in_the_camera_frame_has_a_standard_deviation(
    run, hall_store, four_images, tmp_path
):
    words = ("calibrate", hall_store, four_images, "--out", tmp_path / "c.json")
    words = (*words, "--at 0.1,0,1.5")
    record = run.json(*words)
    own = read_calibration(tmp_path / "c.json")
    sigma = own.uncertain_pose.point_sigma_mm([0.1, 0, 1.5])
    at = own.parent_from_child.apply(np.array([0.1, 0, 1.5])).tolist()
    expected = {
        "point_m": [0.1, 0, 1.5],
        "in_parent_m": at,
        "sigma_mm": pytest.approx(sigma),
    }
    assert record.pop("at") == expected
    assert record == printed(tmp_path / "c.json")
    assert f"{sigma:.2f} mm at (0.1, 0, 1.5) m in the camera frame" in run(*words).out
    page = (
        "report",
        tmp_path / "c.json",
        "--out",
        tmp_path / "r.html",
        "--at 0.1,0,1.5",
    )
    assert run.json(*page)["at"] == expected
    assert (
        "point (0.1, 0, 1.5) m of camera along the axes of base"
        in (tmp_path / "r.html").read_text()
    )
    assert f"{sigma:.2f} mm at (0.1, 0, 1.5) m in the camera frame" in run(*page).out


def test_audit_names_the_episode_with_a_wrong_pose(run, hall_store, hall, tmp_path):
    frame = hall.test[3]
    for name, shift in (("a", 0.0), ("b", 0.05)):
        (tmp_path / name).mkdir()
        write_image(tmp_path / name / "0.png", frame.read_image())
        stated = truth_of(frame) @ SE3.exp([shift, 0, 0, 0, 0, 0])
        np.savetxt(tmp_path / name / "base_from_camera.txt", stated.matrix())
    ran = run("audit", hall_store, tmp_path, "--json")
    assert ran.code == 1
    verdicts = [episode["verdict"] for episode in ran.json["episodes"]]
    assert verdicts == ["right", "wrong"]
    text = run("audit", hall_store, tmp_path).out
    assert text.endswith("1 of 2 episodes state a wrong camera pose\n")
