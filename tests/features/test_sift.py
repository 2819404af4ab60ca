"""Matches of two images that one essential matrix explains."""

import numpy as np

from evercal.features.sift import MIN_INLIERS, SiftFeatures, epipolar_rays
from evercal.geometry import SE3, Camera

FIRST = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
SECOND = Camera(640, 480, 700.0, 690.0, 330.0, 230.0, distortion=(-0.1, 0.02, 0, 0))
MOVED = SE3.exp(np.array([0.2, -0.05, 0.1, 0.05, -0.1, 0.2]))
"""second_from_first."""


def views(
    right: int, wrong: int, noise_px: float = 0.2
) -> tuple[SiftFeatures, SiftFeatures]:
    """Two images with points of a room, and features that only look alike."""
    rng = np.random.default_rng(0)
    count = right + wrong
    first = rng.uniform([40, 30], [280, 210], (count, 2))
    points = FIRST.unproject(first) * rng.uniform(1, 3, (count, 1))
    second = SECOND.project(MOVED.apply(points))
    second[right:] = rng.uniform([80, 60], [560, 420], (wrong, 2))
    descriptors = rng.random((count, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    second = second + rng.normal(0, noise_px, second.shape)
    return SiftFeatures(first, descriptors), SiftFeatures(second, descriptors)


def epipolar_px(rays: np.ndarray) -> np.ndarray:
    """Distances of rays from the true epipolar lines, pixels of the first image."""
    x, y, z = MOVED.translation_m
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    lines = rays[0] @ (cross @ MOVED.rotation_matrix()).T
    distance = (lines * rays[1]).sum(1) / np.linalg.norm(lines[:, :2], axis=1)
    return np.abs(distance) * FIRST.fx


def test_half_of_the_matches_are_wrong() -> None:
    rays = epipolar_rays(*views(60, 60), FIRST, SECOND)
    assert rays is not None
    distance = epipolar_px(rays)
    assert (distance < 1.5).mean() > 0.95
    assert (distance < 1.5).sum() >= 55
    np.testing.assert_allclose(rays[:, :, 2], 1)


def test_few_right_matches_give_none() -> None:
    assert epipolar_rays(*views(MIN_INLIERS - 1, 0), FIRST, SECOND) is None
    assert epipolar_rays(*views(8, 30), FIRST, SECOND) is None


def test_matches_that_stand_still_do_not_count() -> None:
    a, b = views(60, 0)
    shift_px = np.linalg.norm(a.pixels - b.pixels, axis=1)
    rays = epipolar_rays(a, b, FIRST, SECOND, float(np.median(shift_px)))
    assert rays is not None
    assert rays.shape[1] <= 30
    assert epipolar_rays(a, b, FIRST, SECOND, 1000.0) is None
