"""Residuals and derivatives of the hand-eye equation against finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.hand_eye import Setting, SimulatedPairs, recording
from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.pose_equation import PoseEquation, Unknowns
from evercal.geometry import SE3

MOUNTS: tuple[Mount, ...] = ("eye_in_hand", "eye_to_hand")


def exact(mount: Mount, seed: int, scale: float | None = None) -> SimulatedPairs:
    return recording(Setting(mount, 6, noise_mm=0, noise_deg=0, scale=scale), seed)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("scale", [None, 0.2])
def test_true_transforms_leave_nothing(mount: Mount, scale: float | None) -> None:
    drawn = exact(mount, 0, scale)
    equation = drawn.pairs.equation(mount, scale is None)
    at = Unknowns.of(drawn.parent_from_camera, drawn.fixed_from_board, scale or 1.0)
    assert np.abs(equation.residuals(at)).max() < 1e-12


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(MOUNTS), st.integers(0, 1000), st.booleans(), st.booleans())
def test_slopes_are_finite_differences(mount: Mount, seed: int, known: bool, moves: bool) -> None:
    drawn = exact(mount, seed, None if known else 0.5)
    equation = drawn.pairs.equation(mount, known)
    rng = np.random.default_rng(seed)
    if moves:
        equation = replace(equation, velocity=rng.normal(size=(6, 6)))
    at = Unknowns.of(drawn.parent_from_camera, drawn.fixed_from_board, 0.5)
    at = at.moved(rng.normal(0, 0.05, equation.unknowns), known)
    at = replace(at, offset_s=0.0)
    slopes = equation.jacobian(at, equation.residuals(at))
    step = 1e-6
    for i, unit in enumerate(np.eye(equation.unknowns) * step):
        ahead, behind = (equation.residuals(at.moved(way * unit, known)) for way in (1, -1))
        assert np.abs((ahead - behind) / (2 * step) - slopes[:, :, i]).max() < 1e-4


@pytest.mark.parametrize("mount", MOUNTS)
def test_velocity_is_how_the_robot_moves(mount: Mount) -> None:
    # The pose of the gripper a moment later, by its velocity in the axes of the base.
    drawn, step = exact(mount, 3), 1e-6
    rng = np.random.default_rng(4)
    velocity = rng.normal(size=(6, 6))
    robot = drawn.pairs.base_from_gripper
    turn = SE3.exp(np.concatenate([np.zeros((6, 3)), step * velocity[:, 3:]], 1))
    later = SE3(
        (turn @ SE3(robot.rotation_wxyz, np.zeros((6, 3)))).rotation_wxyz,
        robot.translation_m + step * velocity[:, :3],
    )
    at = Unknowns.of(drawn.parent_from_camera, drawn.fixed_from_board)
    pairs = replace(drawn.pairs, velocity=velocity)
    equation = pairs.equation(mount)
    slope = equation.jacobian(at, equation.residuals(at))[:, :, -1]
    moved = replace(drawn.pairs, base_from_gripper=later).equation(mount).residuals(at)
    assert np.abs(moved / step - slope).max() < 1e-4


@pytest.mark.parametrize("mount", MOUNTS)
def test_kinds_of_noise_move_the_residuals_as_said(mount: Mount) -> None:
    drawn, step = exact(mount, 5), 1e-6
    at = Unknowns.of(drawn.parent_from_camera, drawn.fixed_from_board)
    directions = drawn.pairs.equation(mount).noise_directions(at)
    wobble = SE3.exp(np.array([0, 0, 0, step, 0, 0]))
    pairs = drawn.pairs
    robot, camera = pairs.base_from_gripper, pairs.camera_from_board
    spoiled = {
        "rotation about gripper": replace(pairs, base_from_gripper=robot @ wobble),
        "rotation about base": replace(pairs, base_from_gripper=wobble @ robot),
        "rotation about camera": replace(pairs, camera_from_board=wobble @ camera),
        "rotation about board": replace(pairs, camera_from_board=camera @ wobble),
    }
    for kind, changed in spoiled.items():
        residual = changed.equation(mount).residuals(at) / step
        covariance = directions[kind] @ directions[kind].transpose(0, 2, 1)
        # The residual lies in what the kind can do, at the length of one radian.
        length = np.einsum("ni,nij,nj->n", residual, np.linalg.pinv(covariance, 1e-9), residual)
        assert length == pytest.approx(1.0, abs=1e-3)
        other = "rotation about camera" if kind == "turn about base" else "turn about base"
        foreign = directions[other] @ directions[other].transpose(0, 2, 1)
        fitted = foreign @ np.linalg.pinv(foreign, 1e-9) @ residual[..., None]
        assert np.abs(fitted[..., 0] - residual).max() > 0.01


def test_known_noise_is_that_of_the_camera_poses() -> None:
    drawn = exact("eye_in_hand", 6)
    rng = np.random.default_rng(7)
    root = rng.normal(size=(6, 6, 6)) * 1e-4
    covariance = root @ root.transpose(0, 2, 1)
    pairs = replace(drawn.pairs, camera_covariance=covariance)
    at = Unknowns.of(drawn.parent_from_camera, drawn.fixed_from_board)
    known = pairs.equation("eye_in_hand").known_noise(at)
    # Monte Carlo on the camera poses of the first pair.
    draws = rng.normal(size=(20000, 6)) @ root[0].T
    camera = drawn.pairs.camera_from_board[0]
    turn = SE3.exp(np.concatenate([np.zeros((20000, 3)), draws[:, 3:]], 1))
    seen = SE3((camera @ turn).rotation_wxyz, camera.translation_m + draws[:, :3])
    many = PoseEquation.of(drawn.pairs.base_from_gripper[np.zeros(20000, dtype=int)], seen)
    sampled = np.cov(many.residuals(at).T)
    assert sampled == pytest.approx(known[0], abs=0.05 * np.abs(known[0]).max())
