"""Closed-form solutions of exact and noisy poses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from evercal.calibration.pose_pairs.closed_form import motions, park, shah
from evercal.geometry import SE3, pose_distance


def simulated(seed: int, n: int = 8) -> tuple[SE3, SE3, SE3, SE3]:
    """Return fixed_from_parent, camera_from_board, X and Z."""
    rng = np.random.default_rng(seed)
    robot = SE3(rng.normal(size=(n, 4)), rng.normal(size=(n, 3)))
    x, z = (SE3(rng.normal(size=4), rng.normal(size=3)) for _ in range(2))
    return robot, x.inverse() @ robot.inverse() @ z, x, z


def close(a: SE3, b: SE3, tolerance: float = 1e-8) -> bool:
    return bool(np.max(pose_distance(a, b)) < tolerance)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([None, 0.01, 0.3, 7.0, 100.0]))
def test_exact_poses_give_the_exact_solution(seed: int, unit: float | None) -> None:
    robot, camera, x, z = simulated(seed)
    # The camera's translations are in units of `unit` metres.
    scaled = SE3(camera.rotation_wxyz, camera.translation_m / (unit or 1.0))
    by_motions, scale = park(*motions(robot, scaled), scale_known=unit is None)
    world = shah(robot, scaled, scale_known=unit is None)
    assert close(by_motions, x)
    assert close(world.parent_from_camera, x)
    assert close(world.fixed_from_board, z)
    assert (scale, world.scale) == pytest.approx((unit or 1.0,) * 2, rel=1e-9)


def test_rotations_by_180_degrees_are_solved() -> None:
    # The axis of such a rotation has no sign, and its sine is zero; the other poses decide.
    _, _, x, z = simulated(4)
    rotations = Rotation.from_rotvec(
        np.pi * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0], [0, 0.3, 0.1]])
    )
    rng = np.random.default_rng(5)
    robot = SE3(rotations.as_quat(scalar_first=True), rng.normal(size=(5, 3)))
    camera = x.inverse() @ robot.inverse() @ z
    assert close(park(*motions(robot, camera))[0], x)
    assert close(shah(robot, camera).parent_from_camera, x)
