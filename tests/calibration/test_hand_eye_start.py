"""A first `gripper_from_camera` from the motions of pairs of images."""

from contextlib import nullcontext

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.calibration.hand_eye_start import (
    LEAST_ROTATION_DEG,
    PairMotion,
    solve_motions,
)
from evercal.calibration.pose_pairs.checks import require_rotations
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance

TRUTH = SE3.exp([0.05, -0.08, 0.12, 0.4, -1.2, 2.0])


def grippers(count: int, seed: int, size: tuple[float, float] = (0.3, 0.4)) -> SE3:
    rng = np.random.default_rng(seed)
    return SE3.exp(rng.normal(0, np.repeat(size, 3), (count, 6)))


def motions(poses: SE3, truth: SE3, noise_rad: float = 0.0, wrong: int = 0) -> list[PairMotion]:
    """Camera motions from pairs of images, without length; some of them random."""
    rng, pairs = np.random.default_rng(1), []
    cameras = poses @ truth
    for i in range(len(poses)):
        for j in range(i + 1, min(i + 4, len(poses))):
            moved = cameras[j].inverse() @ cameras[i]
            rotation = Rotation.from_quat(moved.rotation_wxyz, scalar_first=True)
            rotation = rotation * Rotation.from_rotvec(rng.normal(0, noise_rad, 3))
            length = np.linalg.norm(moved.translation_m)
            direction = moved.translation_m + rng.normal(0, noise_rad, 3) * length
            pairs.append(PairMotion(i, j, rotation, direction / np.linalg.norm(direction)))
    for k in rng.choice(len(pairs), wrong, replace=False).tolist():
        random, rotation = rng.normal(size=3), Rotation.random(rng=rng)
        pairs[k] = pairs[k]._replace(rotation=rotation, direction=random / np.linalg.norm(random))
    return pairs


def test_exact_motions_give_the_exact_transform() -> None:
    poses = grippers(12, 0)
    start = solve_motions(poses, motions(poses, TRUTH))
    metres, radians = pose_distance(start.gripper_from_camera, TRUTH)
    assert metres < 1e-6
    assert radians < 1e-6
    assert start.pairs == start.of_pairs


@pytest.mark.parametrize("seed", range(3))
def test_wrong_pairs_are_rejected(seed: int) -> None:
    poses = grippers(30, seed)
    start = solve_motions(poses, motions(poses, TRUTH, 0.005, wrong=20))
    metres, radians = pose_distance(start.gripper_from_camera, TRUTH)
    assert metres < 0.01
    assert np.rad2deg(radians) < 0.3
    assert start.pairs <= start.of_pairs - 15


@pytest.mark.parametrize("seed", range(3))
def test_a_camera_that_orbits_one_place_does_not_end_there(seed: int) -> None:
    """In that place the camera would stand still, and errors of all directions would vanish."""
    rng = np.random.default_rng(seed)
    turns = SE3.exp(np.pad(rng.normal(0, 0.25, (25, 3)), ((0, 0), (3, 0))))
    poses = turns @ SE3.from_translation((0.0, 0.0, -0.6)) @ TRUTH.inverse()
    noisy = poses @ SE3.exp(rng.normal(0, np.repeat([3e-4, 3e-4], 3), (25, 6)))
    start = solve_motions(noisy, motions(poses, TRUTH, 0.01))
    assert pose_distance(start.gripper_from_camera, TRUTH)[0] < 0.2


def test_inverted_poses_and_too_few_pairs_are_refused() -> None:
    poses = grippers(20, 0)
    with pytest.raises(InputError, match=r"agree in only .*not the inverse"):
        solve_motions(poses.inverse(), motions(poses, TRUTH))
    with pytest.raises(InputError, match="only 3 pairs"):
        solve_motions(poses[:3], motions(poses[:3], TRUTH))


@pytest.mark.parametrize(
    ("axes", "message"),
    [((0, 0, 0), "hardly turned"), ((0, 20, 0), "one axis only"), ((20, 8, 0), None)],
)
def test_rotations_about_two_axes_are_required(
    axes: tuple[float, ...], message: str | None
) -> None:
    rng = np.random.default_rng(0)
    both = rng.normal(0, 0.2, (30, 3)), rng.normal(0, 1, (30, 3)) * np.deg2rad(axes)
    poses = SE3.exp(np.concatenate(both, 1))
    with pytest.raises(InputError, match=message) if message else nullcontext():
        require_rotations(poses, LEAST_ROTATION_DEG, LEAST_ROTATION_DEG)
