"""Residuals, derivatives and noise model of the hand-eye equation."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.hand_eye import Setting, SimulatedPairs, recording
from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.pose_equation import Unknowns
from evercal.geometry import SE3

MOUNTS: tuple[Mount, ...] = ("eye_in_hand", "eye_to_hand")


def unknowns(parent_from_camera: SE3, fixed_from_board: SE3, scale: float = 1.0) -> Unknowns:
    both = SE3.stack([parent_from_camera, fixed_from_board])
    return Unknowns(both.rotation_matrix(), both.translation_m, scale)


def exact(mount: Mount, seed: int, scale: float | None = None) -> SimulatedPairs:
    return recording(Setting(mount, 6, noise_mm=0, noise_deg=0, scale=scale), seed)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("scale", [None, 0.2])
def test_true_transforms_have_zero_residuals(mount: Mount, scale: float | None) -> None:
    simulated = exact(mount, 0, scale)
    equation = simulated.pairs.equation(mount, scale is None)
    at = unknowns(simulated.parent_from_camera, simulated.fixed_from_board, scale or 1.0)
    assert np.abs(equation.residuals(at)).max() < 1e-12


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(MOUNTS), st.integers(0, 1000), st.booleans(), st.booleans())
def test_derivatives_match_finite_differences(
    mount: Mount, seed: int, known: bool, moving: bool
) -> None:
    simulated = exact(mount, seed, None if known else 0.5)
    equation = simulated.pairs.equation(mount, known)
    rng = np.random.default_rng(seed)
    if moving:
        equation = replace(equation, velocity=rng.normal(size=(6, 6)))
    at = unknowns(simulated.parent_from_camera, simulated.fixed_from_board, 0.5)
    at = at.moved(rng.normal(0, 0.05, equation.unknowns), known)
    at = replace(at, offset_s=0.0)
    jacobian = equation.jacobian(at, equation.residuals(at))
    step = 1e-6
    for i, unit in enumerate(np.eye(equation.unknowns) * step):
        ahead, behind = (equation.residuals(at.moved(sign * unit, known)) for sign in (1, -1))
        assert np.abs((ahead - behind) / (2 * step) - jacobian[:, :, i]).max() < 1e-4


@pytest.mark.parametrize("mount", MOUNTS)
def test_velocity_gives_the_derivative_by_time(mount: Mount) -> None:
    simulated, step = exact(mount, 3), 1e-6
    rng = np.random.default_rng(4)
    velocity = rng.normal(size=(6, 6))
    robot = simulated.pairs.base_from_gripper
    rotation = SE3.exp(np.concatenate([np.zeros((6, 3)), step * velocity[:, 3:]], 1))
    later = SE3(
        (rotation @ SE3(robot.rotation_wxyz, np.zeros((6, 3)))).rotation_wxyz,
        robot.translation_m + step * velocity[:, :3],
    )
    at = unknowns(simulated.parent_from_camera, simulated.fixed_from_board)
    pairs = replace(simulated.pairs, velocity=velocity)
    equation = pairs.equation(mount)
    slope = equation.jacobian(at, equation.residuals(at))[:, :, -1]
    moved = replace(simulated.pairs, base_from_gripper=later).equation(mount).residuals(at)
    assert np.abs(moved / step - slope).max() < 1e-4


@pytest.mark.parametrize("mount", MOUNTS)
def test_noise_directions_match_perturbed_poses(mount: Mount) -> None:
    simulated, step = exact(mount, 5), 1e-6
    at = unknowns(simulated.parent_from_camera, simulated.fixed_from_board)
    directions = simulated.pairs.equation(mount).noise_directions(at)
    small = SE3.exp(np.array([0, 0, 0, step, 0, 0]))
    pairs = simulated.pairs
    robot, camera = pairs.base_from_gripper, pairs.camera_from_board
    perturbed = {
        "rotation about gripper": replace(pairs, base_from_gripper=robot @ small),
        "rotation about base": replace(pairs, base_from_gripper=small @ robot),
        "rotation about camera": replace(pairs, camera_from_board=small @ camera),
        "rotation about board": replace(pairs, camera_from_board=camera @ small),
    }
    for kind, changed in perturbed.items():
        residual = changed.equation(mount).residuals(at) / step
        covariance = directions[kind] @ directions[kind].transpose(0, 2, 1)
        # The residual is a combination of the directions, with a length of one radian.
        length = np.einsum("ni,nij,nj->n", residual, np.linalg.pinv(covariance, 1e-9), residual)
        assert length == pytest.approx(1.0, abs=1e-3)
        other = "rotation about camera" if kind == "rotation about base" else "rotation about base"
        foreign = directions[other] @ directions[other].transpose(0, 2, 1)
        fitted = foreign @ np.linalg.pinv(foreign, 1e-9) @ residual[..., None]
        assert np.abs(fitted[..., 0] - residual).max() > 0.01


def test_known_noise_matches_sampled_camera_poses() -> None:
    simulated = exact("eye_in_hand", 6)
    rng = np.random.default_rng(7)
    root = rng.normal(size=(6, 6, 6)) * 1e-4
    covariance = root @ root.transpose(0, 2, 1)
    pairs = replace(simulated.pairs, camera_covariance=covariance)
    at = unknowns(simulated.parent_from_camera, simulated.fixed_from_board)
    known = pairs.equation("eye_in_hand").known_noise(at)
    draws = rng.normal(size=(20000, 6)) @ root[0].T
    camera = simulated.pairs.camera_from_board[0]
    rotation = SE3.exp(np.concatenate([np.zeros((20000, 3)), draws[:, 3:]], 1))
    noisy = SE3((camera @ rotation).rotation_wxyz, camera.translation_m + draws[:, :3])
    robot = pairs.base_from_gripper[np.zeros(20000, dtype=int)]
    many = PosePairs(("",) * 20000, robot, noisy).equation("eye_in_hand")
    sampled = np.cov(many.residuals(at).T)
    assert sampled == pytest.approx(known[0], abs=0.05 * np.abs(known[0]).max())
