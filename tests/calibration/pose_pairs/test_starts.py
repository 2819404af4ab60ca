"""Closed-form starts of exact poses."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.pose_equation import Extras
from evercal.calibration.pose_pairs.starts import Start, consensus_start
from evercal.geometry import SE3, pose_distance


def started(robot: SE3, camera: SE3, scale_known: bool) -> Start:
    pairs = PosePairs(tuple(map(str, range(len(robot)))), robot, camera)
    equation = pairs.equation("eye_in_hand", Extras.nothing(len(robot)))
    return consensus_start(equation, scale_known)


def transforms(seed: int) -> tuple[SE3, SE3]:
    rng = np.random.default_rng(seed)
    x, z = (SE3(rng.normal(size=4), rng.normal(size=3)) for _ in range(2))
    return x, z


def close(a: SE3, b: SE3, tolerance: float = 1e-6) -> bool:
    return bool(np.max(pose_distance(a, b)) < tolerance)


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.sampled_from([None, 0.01, 0.3, 7.0, 100.0]))
def test_exact_poses_give_the_exact_solution(seed: int, unit: float | None) -> None:
    rng, (x, z) = np.random.default_rng(seed + 1), transforms(seed)
    robot = SE3(rng.normal(size=(8, 4)), rng.normal(size=(8, 3)))
    camera = x.inverse() @ robot.inverse() @ z
    # The camera's translations are in units of `unit` metres.
    scaled = SE3(camera.rotation_wxyz, camera.translation_m / (unit or 1.0))
    start = started(robot, scaled, unit is None)
    assert close(start.at.parent_from_camera, x)
    assert close(start.at.fixed_from_board, z)
    assert start.scale == pytest.approx(unit or 1.0, rel=1e-6)


def test_rotations_by_180_degrees_are_solved() -> None:
    # The axis of such a rotation has no sign, and its sine is zero; the other poses decide.
    x, z = transforms(4)
    rotations = Rotation.from_rotvec(
        np.pi * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0], [0, 0.3, 0.1]])
    )
    rng = np.random.default_rng(5)
    robot = SE3(rotations.as_quat(scalar_first=True), rng.normal(size=(5, 3)))
    camera = x.inverse() @ robot.inverse() @ z
    assert close(started(robot, camera, True).at.parent_from_camera, x)
