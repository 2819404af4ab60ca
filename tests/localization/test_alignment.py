"""Landmarks are searched in an image and refine its pose."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from evercal.geometry import SE3, Camera, pose_distance
from evercal.localization.alignment import (
    AlignmentOptions,
    SearchedImage,
    _shift_px,
    align_pose,
)
from evercal.localization.intrinsics import NOT_STATED
from evercal.localization.keyframe_bank import AlignedLandmarks
from evercal.localization.localizer import Localizer
from evercal.localization.self_calibration import RefinedPose
from evercal.mapping.landmarks import Landmarks
from evercal.mapping.patches import cut_patches, image_pyramid, to_level
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Recording
from evercal.typing import Array

CAMERA = Camera(320, 240, 290.0, 280.0, 161.0, 118.0)
POSE = SE3.exp(np.array([0.4, -0.3, 1.2, 0.3, -0.5, 0.2]))


def test_moved_points_shift_their_pixels() -> None:
    rng = np.random.default_rng(0)
    points = POSE.apply(rng.uniform([-1, -0.8, 1.5], [1, 0.8, 4.0], (40, 3)))
    moves = rng.normal(0, 1e-5, (40, 3))
    inverse = POSE.inverse()
    shift = _shift_px(
        points, moves, inverse.rotation_matrix(), inverse.translation_m, CAMERA
    )
    before, after = (CAMERA.project(inverse.apply(p)) for p in (points, points + moves))
    np.testing.assert_allclose(shift, after - before, rtol=1e-3, atol=1e-7)


def test_depth_errors_shift_pixels_only_away_from_the_keyframe() -> None:
    points = POSE.apply(
        np.random.default_rng(1).uniform([-1, -1, 1], [1, 1, 4], (20, 3))
    )
    inverse = POSE.inverse()
    along = 0.05 * (points - POSE.translation_m)
    rotation = inverse.rotation_matrix()
    position = inverse.translation_m
    np.testing.assert_allclose(
        _shift_px(points, along, rotation, position, CAMERA), 0, atol=1e-9
    )
    beside = SE3.exp(np.array([0.3, 0, 0, 0, 0, 0])) @ inverse
    rotation = beside.rotation_matrix()
    position = beside.translation_m
    assert (
        np.abs(_shift_px(points, along, rotation, position, CAMERA)[:, 0]).min() > 0.5
    )


def test_distorted_image_is_located(hall: Recording, hall_map: MapContents) -> None:
    frame = hall.test[1]
    camera = replace(frame.camera, distortion=(-0.25, 0.0, 0.0, 0.0))
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    source = frame.camera.project(camera.unproject(np.stack([u, v], -1))).astype(
        np.float32
    )
    image = cv2.remap(frame.read_image(), source, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    estimate = Localizer(hall_map).localize(image, camera)
    assert estimate.base_from_camera is not None
    assert estimate.uncertain_pose is not None
    assert frame.base_from_camera is not None
    assert pose_distance(estimate.base_from_camera, frame.base_from_camera)[0] < 0.01
    assert estimate.uncertain_pose.squared_mahalanobis(frame.base_from_camera) < 22.5


def texture(height: int = 240, width: int = 320) -> np.ndarray:
    """(h, w) uint8 with structure of some pixels everywhere; its copies fit side by side."""
    noise = np.random.default_rng(0).uniform(0, 255, (height, width))
    smooth = gaussian_filter(noise, 2.0, mode="wrap")
    return cv2.normalize(smooth, np.empty(0), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def spots(count: int) -> Array:
    return (
        np.random.default_rng(1)
        .integers([20, 20], [300, 220], (count, 2))
        .astype(float)
    )


def wall(image: np.ndarray, pixels: Array) -> AlignedLandmarks:
    """Landmarks on a wall two metres ahead of a keyframe at the origin."""
    count = len(pixels)
    flat = Landmarks(
        pixels, np.full(count, 0.5), np.zeros((count, 2)), np.full(count, 1e-3)
    )
    patches = [
        cut_patches(level, to_level(pixels, i))
        for i, level in enumerate(image_pyramid(image, 2))
    ]
    return AlignedLandmarks(
        flat.surface(CAMERA),
        flat.sigma / flat.inverse_depth,
        np.zeros(3),
        tuple(patches),
    )


def aligned(count: int, options: AlignmentOptions | None = None) -> RefinedPose | None:
    """Align the keyframe's own image from a pose some pixels away."""
    image = texture()
    start = SE3.exp([0.01, -0.01, 0.005, 0.004, -0.003, 0.002])
    return aligned_to(wall(image, spots(count)), image, start, options)


def aligned_to(
    keyframe: AlignedLandmarks,
    image: np.ndarray,
    start: SE3,
    options: AlignmentOptions | None = None,
) -> RefinedPose | None:
    searched = SearchedImage(image_pyramid(image, 2), CAMERA, NOT_STATED)
    options = options or AlignmentOptions()
    return align_pose(searched, [keyframe], start, np.zeros(5), options)


@pytest.mark.parametrize("count", [300, 900, 901, 1000, 1799, 3000])
def test_number_of_searched_landmarks_does_not_jump_at_the_limit(count: int) -> None:
    alignment = aligned(count)
    assert alignment is not None
    assert alignment.observed.expected == min(count, 900)
    assert len(alignment.residual_px) > 0.95 * alignment.observed.expected
    assert (alignment.residual_px < 1).mean() > 0.95
    metres, radians = pose_distance(alignment.pose.pose, SE3.identity())
    assert metres < 5e-4
    assert radians < 3e-4


def test_few_matches_widen_the_next_search() -> None:
    image = texture()
    keyframe = wall(image, spots(3000))
    image[:, 90:] = 0
    occluded = aligned_to(keyframe, image, SE3.exp([0.002, 0, 0, 0, 0, 0]))
    assert occluded is not None
    assert 900 < occluded.observed.expected <= 2700


def test_too_few_landmarks_give_no_pose() -> None:
    assert aligned(11) is None
    assert aligned(300, AlignmentOptions(min_matches=301)) is None


def test_pattern_of_a_keyframe_has_the_period_of_its_wall() -> None:
    across = np.meshgrid(np.arange(20.0, 300, 20), np.arange(20.0, 220, 20))
    pixels = np.stack(across, -1).reshape(-1, 2)
    period = 40 * 2 / np.array([290, 280])
    keyframe = wall(np.tile(texture(40, 40), (6, 8)), pixels)
    steps = keyframe.pattern
    assert keyframe.pattern is steps  # it is calculated once
    for step in (*np.diag(period), *-np.diag(period)):
        assert np.linalg.norm(steps[:, :2] - step, axis=1).min() < 1e-6
    times = np.round(steps[:, :2] / period)
    np.testing.assert_allclose(steps, np.c_[times * period, 0 * times[:, 0]], atol=1e-6)
    assert wall(texture(), pixels).pattern.shape == (0, 3)
