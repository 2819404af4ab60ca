"""Closed forms against exact data and against each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from evercal.calibration.pose_pairs.closed_form import daniilidis, motions, park, shah
from evercal.geometry import SE3, pose_distance


def drawn(seed: int, n: int = 8) -> tuple[SE3, SE3, SE3, SE3]:
    """fixed_from_parent, camera_from_board and the two transforms that tie them."""
    rng = np.random.default_rng(seed)
    robot = SE3(rng.normal(size=(n, 4)), rng.normal(size=(n, 3)))
    x, z = (SE3(rng.normal(size=4), rng.normal(size=3)) for _ in range(2))
    return robot, x.inverse() @ robot.inverse() @ z, x, z


def close(a: SE3, b: SE3, tolerance: float = 1e-9) -> bool:
    metres, radians = pose_distance(a, b)
    return bool(metres < tolerance and radians < tolerance)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.01, 100.0))
def test_exact_poses_give_the_exact_answer(seed: int, unit: float) -> None:
    robot, camera, x, z = drawn(seed)
    a, b = motions(robot, camera)
    assert close(park(a, b)[0], x)
    assert close(daniilidis(a, b), x, 1e-7)
    found_x, found_z, scale = shah(robot, camera)
    assert close(found_x, x)
    assert close(found_z, z)
    assert scale == 1.0
    # The camera's lengths in units of `unit` metres.
    small = SE3(camera.rotation_wxyz, camera.translation_m / unit)
    answer, scale = park(*motions(robot, small), scale_known=False)
    assert close(answer, x, 1e-8)
    assert scale == pytest.approx(unit, rel=1e-9)
    found_x, found_z, scale = shah(robot, small, scale_known=False)
    assert close(found_x, x, 1e-8)
    assert close(found_z, z, 1e-8)
    assert scale == pytest.approx(unit, rel=1e-9)


def test_motions_obey_the_equation() -> None:
    robot, camera, x, _ = drawn(1)
    a, b = motions(robot, camera)
    assert np.abs((a @ x).matrix() - (x @ b).matrix()).max() < 1e-12


def test_three_methods_agree_within_the_noise() -> None:
    robot, camera, x, _ = drawn(2, 25)
    rng = np.random.default_rng(3)
    shaken = camera @ SE3.exp(rng.normal(0, 1, (25, 6)) * np.repeat([0.001, 0.002], 3))
    a, b = motions(robot, shaken)
    answers = [park(a, b)[0], daniilidis(a, b), shah(robot, shaken)[0]]
    for found in answers:
        metres, radians = pose_distance(found, x)
        assert 0 < metres < 0.005
        assert 0 < radians < 0.005


def test_half_turns_break_nothing() -> None:
    # A half turn's axis has no sign, and its sine is zero: the other poses must carry the answer.
    _, _, x, z = drawn(4)
    turns = Rotation.from_rotvec(
        np.pi * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0], [0, 0.3, 0.1]])
    )
    rng = np.random.default_rng(5)
    robot = SE3(turns.as_quat(scalar_first=True), rng.normal(size=(5, 3)))
    camera = x.inverse() @ robot.inverse() @ z
    assert close(park(*motions(robot, camera))[0], x)
    assert close(shah(robot, camera)[0], x)


def test_too_few_are_refused() -> None:
    robot, camera, _, _ = drawn(6, 2)
    a, b = motions(robot, camera)
    with pytest.raises(ValueError, match="two motions"):
        park(a, b)
    with pytest.raises(ValueError, match="two motions"):
        daniilidis(a, b)
    with pytest.raises(ValueError, match="three poses"):
        shah(robot, camera)
