"""A first `gripper_from_camera` from the motions of pairs of images."""

import itertools
from contextlib import nullcontext

import numpy as np
import pytest

from evercal.calibration.from_map.hand_eye_start import (
    LEAST_ROTATION_DEG,
    ImagePair,
    start_from_matches,
)
from evercal.calibration.pose_pairs.checks import require_rotations
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.robot.mount import EYE_IN_HAND, EYE_TO_HAND, Mount

TRUTH = SE3.exp([0.05, -0.08, 0.12, 0.4, -1.2, 2.0])


def grippers(count: int, seed: int, size: tuple[float, float] = (0.3, 0.4)) -> SE3:
    rng = np.random.default_rng(seed)
    return SE3.exp(rng.normal(0, np.repeat(size, 3), (count, 6)))


def image_pairs(
    poses: SE3, truth: SE3, noise_px: float = 0.0, wrong: int = 0
) -> list[ImagePair]:
    """Pairs of images of points in front of the cameras, at 500 px; some of them random."""
    rng = np.random.default_rng(1)
    pairs = []
    cameras = poses @ truth
    middle = cameras.apply(np.array([0.0, 0.0, 0.6])).mean(0)
    points = middle + rng.normal(0, 0.1, (40, 3))
    for i in range(len(poses)):
        for j in range(i + 1, min(i + 4, len(poses))):
            seen = [cameras[k].inverse().apply(points) for k in (i, j)]
            rays = np.stack([points / points[:, 2:] for points in seen])
            rays[..., :2] += rng.normal(0, noise_px / 500, rays[..., :2].shape)
            pairs.append(ImagePair(i, j, rays))
    for k in rng.choice(len(pairs), wrong, replace=False).tolist():
        rays = np.concatenate([rng.normal(0, 0.3, (2, 40, 2)), np.ones((2, 40, 1))], 2)
        pairs[k] = pairs[k]._replace(rays=rays)
    return pairs


@pytest.mark.parametrize("mount", [EYE_IN_HAND, EYE_TO_HAND])
def test_exact_pairs_give_the_exact_transform(mount: Mount) -> None:
    poses = grippers(12, 0)
    truth = TRUTH
    if not mount.moves:  # a fixed camera, 1.3 m from the base
        truth = SE3.exp([1.0, -0.3, 0.8, 0.4, -1.2, 2.0])
        poses = (
            SE3.from_translation(truth.apply(np.array([0.0, 0.0, 0.6]))) @ poses
        ).inverse()
    start = start_from_matches(poses, image_pairs(poses, truth), mount)
    metres, radians = pose_distance(start.parent_from_camera, truth)
    assert metres < 1e-4
    assert radians < 1e-4
    assert start.pairs == start.of_pairs


@pytest.mark.parametrize("mount", [EYE_IN_HAND, EYE_TO_HAND])
@pytest.mark.parametrize("axis", range(2), ids=["mirrored", "upside down"])
def test_mirrored_images_are_named(mount: Mount, axis: int) -> None:
    """They agree with the motion of the gripper, with all points behind the camera."""
    for seed in range(3):
        poses = grippers(15, seed)
        pairs = image_pairs(poses, TRUTH, 0.3)
        for pair in pairs:
            pair.rays[..., axis] *= -1
        with pytest.raises(InputError, match="agree only mirrored"):
            start_from_matches(poses, pairs, mount)


def test_left_handed_poses_are_named() -> None:
    poses = grippers(15, 4)
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    left_handed = SE3.from_matrix(mirror @ poses.matrix() @ mirror)
    with pytest.raises(InputError, match="poses of a left-handed frame"):
        start_from_matches(left_handed, image_pairs(poses, TRUTH), EYE_IN_HAND)


@pytest.mark.parametrize("seed", range(3))
def test_wrong_pairs_are_rejected(seed: int) -> None:
    poses = grippers(30, seed)
    start = start_from_matches(
        poses, image_pairs(poses, TRUTH, 0.5, wrong=20), EYE_IN_HAND
    )
    metres, radians = pose_distance(start.parent_from_camera, TRUTH)
    assert metres < 0.003
    assert np.rad2deg(radians) < 0.1
    assert start.pairs <= start.of_pairs - 15


@pytest.mark.parametrize("seed", range(3))
def test_a_camera_that_orbits_one_place_does_not_end_there(seed: int) -> None:
    """In that place the camera would stand still, and errors of all directions would vanish."""
    rng = np.random.default_rng(seed)
    turns = SE3.exp(np.pad(rng.normal(0, 0.25, (25, 3)), ((0, 0), (3, 0))))
    poses = turns @ SE3.from_translation((0.0, 0.0, -0.6)) @ TRUTH.inverse()
    noisy = poses @ SE3.exp(rng.normal(0, np.repeat([3e-4, 3e-4], 3), (25, 6)))
    start = start_from_matches(noisy, image_pairs(poses, TRUTH, 0.5), EYE_IN_HAND)
    assert pose_distance(start.parent_from_camera, TRUTH)[0] < 0.3


@pytest.mark.parametrize("seed", range(4))
def test_a_thing_of_a_few_pixels_suffices(seed: int) -> None:
    """Of 4 cm in 1.3 m: its essential matrices may be wrong by any angle."""
    rng = np.random.default_rng(seed)
    truth = SE3.exp([1.0, -0.3, 0.8, 0.4, -1.2, 2.0])
    place = truth.apply(np.array([0.0, 0.0, 1.3]))
    poses = (SE3.from_translation(place) @ grippers(20, seed, (0.1, 0.3))).inverse()
    points = rng.uniform(-0.02, 0.02, (30, 3)) * (1, 0.2, 1) + (0, 0, 0.2)
    pairs = []
    for i, j in itertools.pairwise(range(20)):
        seen = [(poses @ truth)[k].inverse().apply(points) for k in (i, j)]
        rays = np.stack([points / points[:, 2:] for points in seen])
        rays[..., :2] += rng.normal(0, 0.3 / 600, rays[..., :2].shape)
        pairs.append(ImagePair(i, j, rays))
    start = start_from_matches(poses, pairs, EYE_TO_HAND)
    metres, radians = pose_distance(start.parent_from_camera, truth)
    assert metres < 0.05
    assert np.rad2deg(radians) < 2
    assert start.pairs == start.of_pairs


def test_inverted_poses_and_too_few_pairs_are_refused() -> None:
    poses = grippers(20, 0)
    with pytest.raises(InputError, match=r"agree in only .*not the inverse"):
        start_from_matches(poses.inverse(), image_pairs(poses, TRUTH), EYE_IN_HAND)
    with pytest.raises(InputError, match="only 3 pairs"):
        start_from_matches(poses[:3], image_pairs(poses[:3], TRUTH), EYE_IN_HAND)


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
