"""Offsets of joints in the output of `learn` and `eye-to-hand`."""

from typing import Any

import numpy as np

from evercal.calibration.calibration import Calibration, JointOffset
from evercal.cli.calibrate import joint_lines
from evercal.geometry import SE3
from evercal.map import Map
from evercal.recordings import Recording

PAN = JointOffset("pan", 0.0, 0.02, open="its offset turns the frame of the base")
LIFT = JointOffset("lift", np.deg2rad(1.25), np.deg2rad(0.2))
SMALL = JointOffset("elbow", np.deg2rad(-0.1), np.deg2rad(0.06))
RAIL = JointOffset("rail", 0.0001, 0.0002, is_angle=False)


def test_significant_offsets_and_their_use_are_named():
    lines = [*joint_lines((PAN, LIFT, SMALL), "wrist.json")]
    assert lines[0] == "joint lift: add +1.25 deg (standard deviation 0.20)"
    words = "evercal export wrist.json --format corrected_urdf --urdf ROBOT.urdf --out NEW.urdf"
    assert lines[1].endswith(words)
    assert lines[2:] == [
        "joint pan: not determined; its offset turns the frame of the base"
    ]


def test_insignificant_offsets_have_a_bound():
    bound = "joints: no offset above 0.22 deg (elbow)"
    lines = [*joint_lines((SMALL, PAN), "wrist.json")]
    assert lines == [
        bound,
        "joint pan: not determined; its offset turns the frame of the base",
    ]
    assert [*joint_lines((SMALL, RAIL), "wrist.json")] == [f"{bound}, 0.50 mm (rail)"]
    assert [*joint_lines((), "wrist.json")] == []


def test_eye_to_hand_prints_them(run, rooms, tmp_path, monkeypatch):
    def made(cell: Map, recording: Recording, **_: Any) -> Calibration:
        small = 1e-8 * np.eye(6)
        joints = (LIFT,)
        return Calibration(
            "eye_to_hand",
            SE3.identity(),
            small,
            joints=joints,
            joint_covariance=np.eye(1),
        )

    monkeypatch.setattr(Map, "eye_to_hand", made)
    ran = run("eye-to-hand", rooms[0], "--out", tmp_path / "c.json")
    assert ran.code == 0
    assert "joint lift: add +1.25 deg (standard deviation 0.20)" in ran.out
    assert f"evercal export {tmp_path / 'c.json'} --format corrected_urdf" in ran.out
