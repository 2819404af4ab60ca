"""Calibration files, refusal of files that contradict themselves, and verdicts with advice."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.calibration import (
    Calibration,
    ErrorTerm,
    ImageUse,
    JointOffset,
    read_calibration,
)
from evercal.calibration.checks import Checks
from evercal.calibration.verdict import TIERS, expected_error, tier, verdict
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, cross_matrix, pose_distance
from evercal.robot.frame_names import FrameNames

SAME = {"gripper": "panda_hand", "camera": "panda_hand"}


def example() -> Calibration:
    return Calibration(
        "eye_in_hand",
        SE3.exp([0.1, -0.2, 0.3, 0.4, -0.5, 0.6]),
        np.diag([1e-6, 1e-6, 4e-6, 1e-8, 1e-8, 4e-8]),
        FrameNames("base", "panda_hand", "camera_color_optical_frame"),
        Camera(640, 480, 600, 601, 320, 240),
        (ImageUse("a.png", True, "", 0.5, 0.1), ImageUse("b.png", False, "blurred")),
        (ErrorTerm("map", 0.3, 0.01),),
        Checks.from_dict({"held_out_mm": 1.5}),
        "good for bin picking",
        {"command": "solve"},
        "2026-01-01T00:00:00+00:00",
        joints=(
            JointOffset("lift", 0.01, 0.002),
            JointOffset("rail", 0.0, 0.1, False, "move it"),
        ),
        joint_covariance=np.array([[4e-6, 1e-6], [1e-6, 1e-2]]),
    )


def test_round_trip(tmp_path: Path) -> None:
    calibration = example()
    calibration.write(tmp_path / "c.json")
    read = read_calibration(tmp_path / "c.json")
    assert (
        max(pose_distance(read.parent_from_child, calibration.parent_from_child))
        < 1e-12
    )
    assert read.to_dict() == calibration.to_dict()
    assert read.images == calibration.images
    assert read.joints == calibration.joints
    np.testing.assert_array_equal(read.joint_covariance, calibration.joint_covariance)
    old = {
        key: value for key, value in calibration.to_dict().items() if "joint" not in key
    }
    assert Calibration.from_dict(old).joint_covariance.shape == (0, 0)
    assert read.meaning.startswith("pose of camera_color_optical_frame in panda_hand")


def test_sigmas_are_root_mean_squares_over_the_axes() -> None:
    assert example().sigma_mm == pytest.approx(1000 * np.sqrt(2e-6))
    assert example().sigma_deg == pytest.approx(np.rad2deg(np.sqrt(2e-8)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "x"}, "'format' is not"),
        ({"version": 2}, "version 2"),
        ({"mount": "eye"}, "'mount'"),
        ({"translation_m": [1, 2, 3]}, "different poses"),
        ({"quaternion_wxyz": [0, 0, 0, 0]}, "length zero"),
        ({"covariance": [[1]]}, "covariance"),
        ({"covariance": (-np.eye(6)).tolist()}, "negative eigenvalue"),
        ({"images": [{"nam": 1}]}, "wrong kind"),
        ({"child_frame": "panda_hand"}, "'frames' names other frames"),
        ({"child_frame": "panda_hand", "frames": SAME}, "both called"),
        ({"frames": {"base": "a", "gripper": "a"}}, "both called 'a'"),
        ({"frames": 5}, "wrong kind"),
        ({"frames": {"tool": "tcp"}}, "wrong kind"),
        ({"source": 5}, "'source' is an object"),
        ({"joint_covariance": []}, "the covariance of 2 joints is"),
        ({"joints": [{"name": "lift"}]}, "wrong kind"),
        ({"checks": [7]}, "'checks' is an object"),
    ],
)
def test_contradictions_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    file = tmp_path / "c.json"
    file.write_text(json.dumps({**example().to_dict(), **change}))
    with pytest.raises(InputError, match=message):
        read_calibration(file)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="missing"):
        read_calibration(tmp_path / "none.json")
    (tmp_path / "text").write_text("hello")
    with pytest.raises(InputError, match="give the JSON"):
        read_calibration(tmp_path / "text")
    data = example().to_dict()
    del data["covariance"]
    (tmp_path / "half").write_text(json.dumps(data))
    with pytest.raises(InputError, match="'covariance' is missing"):
        read_calibration(tmp_path / "half")


def calibration(mm: float, deg: float, **checks: float) -> Calibration:
    """A calibration with this root mean square error in space."""
    axes = np.repeat([mm / 1000, np.deg2rad(deg)], 3) / np.sqrt(3)
    return Calibration(
        "eye_in_hand",
        SE3.identity(),
        np.diag(axes**2),
        checks=Checks.from_dict(checks),
    )


@pytest.mark.parametrize(
    ("mm", "deg", "name"),
    [
        (0.9, 0.09, "precision assembly"),
        (1.1, 0.09, "bin picking"),
        (0.9, 0.11, "bin picking"),
        (3.1, 0.1, "tabletop tasks"),
        (9.9, 0.9, "tabletop tasks"),
        (0.1, 1.1, None),
        (10.1, 0.1, None),
    ],
)
def test_worse_of_translation_and_rotation_decides(
    mm: float, deg: float, name: str | None
) -> None:
    use = tier(calibration(mm, deg))
    assert (use.name if use else None) == name
    assert verdict(calibration(mm, deg)).startswith(
        f"Good for {name}" if name else "Unusable"
    )


def test_the_noise_of_single_poses_is_no_error_of_the_calibration() -> None:
    # A single tag in 241 images: one pose is off by 30 mm, the calibration by half a millimetre.
    noisy = calibration(0.5, 0.05, held_out_mm=30.0, held_out_deg=3.0)
    assert tier(noisy) is TIERS[0]
    assert "single held-out poses differ by 30 mm" in verdict(noisy)
    assert "more poses" in verdict(
        calibration(2.0, 0.05, held_out_mm=0.5, held_out_deg=0.05)
    )
    # Two halves differ by twice the error of their mean.
    halves = calibration(0.5, 0.05, repeatability_mm=3.0)
    assert expected_error(halves) == pytest.approx((1.5, 0.05))
    turned = calibration(0.5, 0.05, repeatability_deg=0.4)
    assert expected_error(turned) == pytest.approx((0.5, 0.2))
    small = calibration(0.5, 0.05, repeatability_mm=0.9, repeatability_deg=0.09)
    assert expected_error(small) == pytest.approx((0.5, 0.05))


@pytest.mark.parametrize(
    ("mm", "advice"),
    [
        (0.5, "Check it on the robot before use"),
        (2.0, "For precision assembly: more poses"),
        (5.0, "For bin picking: more poses"),
        (50.0, "For tabletop tasks: more poses"),
    ],
)
def test_advice_is_for_the_next_better_use(mm: float, advice: str) -> None:
    held = calibration(mm, 0.05, held_out_mm=2.0, held_out_deg=0.05)
    assert advice in verdict(held)


def test_a_verdict_says_what_is_known() -> None:
    plain = verdict(calibration(2.0, 0.05))
    assert plain == (
        "Good for bin picking (within 3 mm and 0.3 deg). Expected error 2.00 mm and 0.05 deg."
    )
    half = calibration(20.0, 0.05, held_out_mm=2.0)
    assert verdict(half) == (
        "Unusable: even tabletop tasks ask for 10 mm and 1 deg."
        " Expected error 20 mm and 0.05 deg."
    )
    for mm, words in ((9.994, "9.99 mm"), (10.0, "10 mm"), (10.6, "11 mm")):
        held = verdict(calibration(2.0, 0.05, held_out_mm=mm, held_out_deg=0.05))
        assert f"; single held-out poses differ by {words} and 0.05 deg" in held


def test_a_camera_that_is_known_best_at_the_target_counts_where_it_is() -> None:
    """Its errors turn it about the target."""
    target = np.array([0.0, 0.0, 2.0])
    about = np.concatenate([cross_matrix(target), np.eye(3)])
    turned = calibration(0.0, 0.0, target_m=2.0)
    turned = replace(turned, covariance=np.deg2rad(0.1) ** 2 * about @ about.T)
    assert turned.uncertain_pose.point_sigma_mm(target) == pytest.approx(0, abs=1e-6)
    # Two axes move the camera by 2 m times 0.1 deg.
    moved = 2000 * np.deg2rad(0.1) * np.sqrt(2)
    assert expected_error(turned)[0] == pytest.approx(moved)


def test_an_error_of_just_a_bound_is_not_below_it() -> None:
    small = calibration(0.1, 0.01)
    for checks in ({"repeatability_mm": 2.0}, {"repeatability_deg": 0.2}):
        assert tier(replace(small, checks=Checks.from_dict(checks))) is TIERS[1]


def test_a_rotation_error_counts_at_the_target() -> None:
    near, far = (calibration(0.5, 0.1, target_m=target) for target in (0.0, 2.0))
    assert expected_error(near)[0] == pytest.approx(0.5)
    # Two of three axes move the target: 2 m times 0.1 deg times sqrt(2 / 3).
    moved = 2000 * np.deg2rad(0.1) * np.sqrt(2 / 3)
    assert expected_error(far)[0] == pytest.approx(np.hypot(0.5, moved))
    assert "2.00 m from the camera" in verdict(
        replace(far, checks=Checks.from_dict({"target_m": 2.0}))
    )
