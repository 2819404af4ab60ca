"""Residuals, derivatives and noise model of the hand-eye equation."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from benchmarks.hand_eye import Setting, SimulatedPairs, recording
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.pose_equation import Extras, PoseEquation, Unknowns
from evercal.geometry import SE3
from evercal.robot.mount import MountName

MOUNTS: tuple[MountName, ...] = ("eye_in_hand", "eye_to_hand")


def unknowns(
    parent_from_camera: SE3, fixed_from_board: SE3, extras: int = 0
) -> Unknowns:
    both = SE3.stack([parent_from_camera, fixed_from_board])
    return Unknowns(both.rotation_matrix(), both.translation_m, np.zeros(extras))


def exact(mount: MountName, seed: int) -> SimulatedPairs:
    return recording(Setting(mount, 6, noise_mm=0, noise_deg=0), seed)


def equation_of(pairs: PosePairs, mount: MountName) -> PoseEquation:
    return pairs.equation(mount, Extras.nothing(len(pairs)))


def residuals(pairs: PosePairs, mount: MountName, at: Unknowns) -> np.ndarray:
    return equation_of(pairs, mount).system(at).residual


@settings(max_examples=20)
@given(st.sampled_from(MOUNTS), st.integers(0, 1000), st.booleans())
def test_derivatives_match_finite_differences(
    mount: MountName, seed: int, moving: bool
) -> None:
    simulated = exact(mount, seed)
    rng = np.random.default_rng(seed)
    pairs = simulated.pairs
    extras = Extras.nothing(6)
    for name in ("shared depth", "size"):
        extras = extras.with_one(name, rng.normal(size=(6, 6)), 0.1)
    if moving:
        pairs = replace(pairs, velocity=rng.normal(size=(6, 6)))
        extras = extras.with_one("clock", np.zeros((6, 6)), np.inf)
    equation = pairs.equation(mount, extras)
    at = unknowns(
        simulated.parent_from_camera, simulated.fixed_from_board, len(extras.names)
    )
    step = np.r_[rng.normal(0, 0.05, 12), np.zeros(len(extras.names))]
    at = at.moved(step)
    system = equation.system(at)
    # A prior of 10 % is an information of a hundred.
    assert np.diag(system.prior)[12:14] == pytest.approx([100.0, 100.0])
    step = 1e-6
    for i, unit in enumerate(np.eye(equation.unknowns) * step):
        ahead, behind = (
            equation.system(at.moved(sign * unit)).residual for sign in (1, -1)
        )
        assert (
            np.abs((ahead - behind) / (2 * step) - system.jacobian[:, :, i]).max()
            < 1e-4
        )


@pytest.mark.parametrize("mount", MOUNTS)
def test_velocity_gives_the_derivative_by_time(mount: MountName) -> None:
    simulated = exact(mount, 3)
    step = 1e-6
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
    timed = Extras.nothing(6).with_one("clock", np.zeros((6, 6)), np.inf)
    still = replace(at, extras=np.zeros(1))
    slope = pairs.equation(mount, timed).system(still).jacobian[:6, :, -1]
    moved = residuals(replace(simulated.pairs, base_from_gripper=later), mount, at)
    assert np.abs(moved / step - slope).max() < 1e-4


@pytest.mark.parametrize("mount", MOUNTS)
def test_noise_directions_match_perturbed_poses(mount: MountName) -> None:
    simulated = exact(mount, 5)
    step = 1e-6
    at = unknowns(simulated.parent_from_camera, simulated.fixed_from_board)
    directions = equation_of(simulated.pairs, mount).system(at).directions
    small = SE3.exp(np.array([0, 0, 0, step, 0, 0]))
    pairs = simulated.pairs
    robot = pairs.base_from_gripper
    camera = pairs.camera_from_board
    perturbed = {
        "rotation about gripper": replace(pairs, base_from_gripper=robot @ small),
        "rotation about board": replace(pairs, camera_from_board=camera @ small),
    }
    for kind, changed in perturbed.items():
        residual = residuals(changed, mount, at) / step
        covariance = directions[kind] @ directions[kind].transpose(0, 2, 1)
        # The residual is a combination of the directions, with a length of one radian.
        length = np.einsum(
            "ni,nij,nj->n", residual, np.linalg.pinv(covariance, 1e-9), residual
        )
        assert length == pytest.approx(1.0, abs=1e-3)
        [other] = set(perturbed) - {kind}
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
    known = equation_of(pairs, "eye_in_hand").system(at).known
    draws = rng.normal(size=(20000, 6)) @ root[0].T
    camera = simulated.pairs.camera_from_board[0]
    rotation = SE3.exp(np.concatenate([np.zeros((20000, 3)), draws[:, 3:]], 1))
    noisy = SE3((camera @ rotation).rotation_wxyz, camera.translation_m + draws[:, :3])
    robot = pairs.base_from_gripper[np.zeros(20000, dtype=int)]
    sampled = np.cov(
        residuals(PosePairs(("",) * 20000, robot, noisy), "eye_in_hand", at).T
    )
    assert sampled == pytest.approx(known[0], abs=0.05 * np.abs(known[0]).max())
