"""Two calibrations of an arm: which joints have changed between them."""

from dataclasses import replace

import numpy as np
import pytest

from evercal.calibration.arm_change import arm_change
from evercal.calibration.calibration import Calibration, JointOffset
from evercal.errors import InputError
from evercal.geometry import SE3

# Two neighbours that look alike to the camera: their sum is known, their difference is not.
COVARIANCE = np.deg2rad(0.05) ** 2 * np.array([[9.0, -8.8, 0], [-8.8, 9, 0], [0, 0, 1]])
NAMES = ("pan", "lift", "elbow", "wrist")


def calibration(
    offsets_deg: list[float], names: tuple[str, ...] = NAMES
) -> Calibration:
    """An arm whose first offset is open; its other three have COVARIANCE."""
    covariance = np.zeros((4, 4))
    covariance[1:, 1:] = COVARIANCE
    covariance[0, 0] = 1.0
    joints = tuple(
        JointOffset(
            name,
            np.deg2rad(offset),
            np.sqrt(variance),
            open="" if i else "turns the base",
        )
        for i, (name, offset, variance) in enumerate(
            zip(names, offsets_deg, np.diag(covariance), strict=True)
        )
    )
    eye = SE3.identity(), 1e-8 * np.eye(6)
    return Calibration("eye_in_hand", *eye, joints=joints, joint_covariance=covariance)


def test_one_joint_that_changed_is_named_where_neighbours_are_alike() -> None:
    confidence, changed, joints = arm_change(
        calibration([0, 0.2, 0.1, 0.3]), calibration([50, 0.7, 0.1, 0.3])
    )
    assert confidence > 0.999
    assert changed == ["lift"]
    assert [joint.name for joint in joints] == list(NAMES)
    assert joints[0].open == "turns the base"
    assert np.rad2deg(joints[1].offset) == pytest.approx(0.5)
    # Below three standard deviations by itself: only the sum with its neighbour is known.
    assert np.rad2deg(joints[1].sigma) == pytest.approx(0.15 * np.sqrt(2))


def test_two_joints_that_changed_are_named() -> None:
    _, changed, _ = arm_change(
        calibration([0, 0, 0, 0]), calibration([0, 1.0, 0, -0.5])
    )
    assert changed == ["lift", "wrist"]


def test_joints_that_did_not_change_rarely_alarm() -> None:
    rng = np.random.default_rng(3)
    alarms = 0
    root = np.rad2deg(np.linalg.cholesky(COVARIANCE))
    for _ in range(300):
        two = [calibration([0, *(root @ rng.normal(size=3))]) for _ in range(2)]
        alarms += len(arm_change(*two)[1]) > 0
    assert 0 < alarms <= 9  # 1 % of them, and not none: the covariance counts


def test_changes_too_small_to_matter_do_not_count() -> None:
    sure = [
        replace(calibration([0, 0, 0, w]), joint_covariance=1e-12 * np.eye(4))
        for w in (0, 0.04)
    ]
    confidence, changed, _ = arm_change(*sure)
    assert confidence > 0.99
    assert changed == []


def test_other_arms_and_open_offsets_are_refused() -> None:
    one = calibration([0, 0, 0, 0])
    with pytest.raises(
        InputError, match=r"\[pan, lift, elbow, wrist\], the recording of \[a, b"
    ):
        arm_change(one, calibration([0, 0, 0, 0], ("a", "b", "c", "d")))
    with pytest.raises(
        InputError, match=r"recording of \[\]: give a recording of the same arm"
    ):
        arm_change(one, replace(one, joints=(), joint_covariance=np.zeros((0, 0))))
    still = replace(one, joints=tuple(replace(joint, open="x") for joint in one.joints))
    with pytest.raises(InputError, match="no joint's offset is determined in both"):
        arm_change(one, still)
