import time
from dataclasses import replace

import numpy as np
import pytest

from evercal.geometry import SE3, cross_matrix
from evercal.robot.joint_slopes import joint_slopes
from evercal.robot.known_arms import known_arm
from evercal.typing import Array


def _values(name: str, count: int = 60) -> Array:
    arm = known_arm(name)
    noise = np.random.default_rng(0).normal(0, 0.2, (count, len(arm.joints)))
    return arm.ranges[:, 1] + noise


@pytest.mark.parametrize("name", ["ur5e", "panda", "irb1200-5-0.9", "lrmate200id"])
def test_slopes_of_a_named_arm_hold_those_of_its_inner_joints(name: str) -> None:
    arm = known_arm(name)
    values = _values(name)
    poses = arm.poses(values)
    slopes = joint_slopes(poses, replace(arm, assumed=((0, 0),)))
    inner = len(arm.joints) - 2
    assert slopes.shape == (60, 6, inner)
    if inner < 5:
        np.testing.assert_allclose(slopes, arm.slopes(values)[:, :, 1:-1], atol=1e-3)
    mixed = joint_slopes(poses, arm)
    count = mixed.shape[2] // inner
    assert count > 1
    np.testing.assert_allclose(mixed[:, :, :inner] * np.sqrt(count), slopes, atol=1e-3)


@pytest.mark.parametrize("name", ["ur5e", "iiwa14", "kr6-r900-sixx", "hc10"])
def test_joints_of_an_unknown_arm_hide_no_offset(name: str) -> None:
    # Offsets of 0.2 deg, measured to 0.1 mm and 0.02 deg: how far the mount is from its estimate,
    # in its own deviations, and in metres beside an estimate by independent errors.
    arm = known_arm(name)
    poses = arm.poses(_values(name, 25))
    true = arm.slopes(_values(name, 25))[:, :, 1:-1].reshape(150, -1)
    usual = joint_slopes(poses, None).reshape(150, -1)
    noise = np.diag(np.tile([1e-8] * 3 + [np.radians(0.02) ** 2] * 3, 25))
    offset = np.radians(0.2) ** 2
    stated = noise + offset * usual @ usual.T
    true = noise + offset * true @ true.T
    d2, error_m = _mount(poses, stated, true)
    assert d2 < 16
    assert error_m < 0.7 * _mount(poses, noise, true)[1]


def _mount(poses: SE3, stated: Array, true: Array) -> tuple[float, float]:
    """Mean squared deviation of the mount's six numbers, 6 if all is true, and its error."""
    base = [np.linalg.inv(_adjoint(pose.matrix())) for pose in poses]
    design = np.concatenate([np.concatenate([np.eye(6), one], 1) for one in base])
    weighted = np.linalg.solve(stated, design)
    covariance = np.linalg.inv(design.T @ weighted)
    estimate = covariance @ weighted.T
    spread = (estimate @ true @ estimate.T)[:6, :6]
    d2 = np.trace(np.linalg.solve(covariance[:6, :6], spread))
    return float(d2), float(np.sqrt(np.trace(spread[:3, :3])))


def _adjoint(pose: Array) -> Array:
    adjoint = np.kron(np.eye(2), pose[:3, :3])
    adjoint[:3, 3:] = cross_matrix(pose[:3, 3]) @ pose[:3, :3]
    return adjoint


def test_an_unknown_arm_costs_milliseconds() -> None:
    poses = known_arm("ur5e").poses(_values("ur5e"))
    start = time.process_time()
    slopes = joint_slopes(poses, None)
    assert time.process_time() - start < 0.05
    assert slopes.shape[:2] == (60, 6)
    assert np.isfinite(slopes).all()


def test_any_poses_have_slopes() -> None:
    still = SE3.identity((5,))
    assert np.isfinite(joint_slopes(still, None)).all()
