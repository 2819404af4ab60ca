"""How landmarks' own uncertainty enters, and what a pose is accepted by."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3, pose_distance
from evercal.localization import alignment as module
from evercal.localization.alignment import _shift_px, _through_lens
from evercal.localization.localizer import Localizer
from evercal.localization.pose_refinement import refine_pose
from evercal.localization.query import Hypothesis
from evercal.mapping.patches import whitening
from evercal.mapping.scene_maps import SceneMaps
from evercal.recordings.frame import Recording

Array = NDArray[np.floating]

CAMERA = Camera(320, 240, 290.0, 280.0, 161.0, 118.0)
POSE = SE3.exp(np.array([0.4, -0.3, 1.2, 0.3, -0.5, 0.2]))


def test_a_move_of_a_point_is_a_move_of_its_pixel() -> None:
    rng = np.random.default_rng(0)
    points = POSE.apply(rng.uniform([-1, -0.8, 1.5], [1, 0.8, 4.0], (40, 3)))
    moves = rng.normal(0, 1e-5, (40, 3))
    inverse = POSE.inverse()
    found = _shift_px(points, moves, inverse.rotation_matrix(), inverse.translation_m, CAMERA)
    before, after = (CAMERA.project(inverse.apply(p)) for p in (points, points + moves))
    np.testing.assert_allclose(found, after - before, rtol=1e-3, atol=1e-7)


def test_depth_says_nothing_where_the_keyframe_was_taken() -> None:
    # Seen from the keyframe itself, a landmark of another depth is at the same pixel.
    points = POSE.apply(np.random.default_rng(1).uniform([-1, -1, 1], [1, 1, 4], (20, 3)))
    inverse = POSE.inverse()
    along = 0.05 * (points - POSE.translation_m)
    turn, shift = inverse.rotation_matrix(), inverse.translation_m
    np.testing.assert_allclose(_shift_px(points, along, turn, shift, CAMERA), 0, atol=1e-9)
    aside = SE3.exp(np.array([0.3, 0, 0, 0, 0, 0])) @ inverse
    turn, shift = aside.rotation_matrix(), aside.translation_m
    assert np.abs(_shift_px(points, along, turn, shift, CAMERA)[:, 0]).min() > 0.5


WIDE = Camera(640, 480, 520.0, 500.0, 322.0, 238.0)
BARREL = replace(WIDE, distortion=(-0.3, 0.0, 0.0, 0.0))


def many_runs(camera: Camera) -> tuple[Array, float]:
    """By axis, the variance of poses over the claimed one; the median distance of the pixels."""
    rng = np.random.default_rng(2)
    pixels = rng.uniform([5, 5], [634, 474], (60, 2))
    points = POSE.apply(camera.unproject(pixels) * rng.uniform(1.5, 4, (60, 1)))
    white = np.tile(np.eye(2) / 0.2, (60, 1, 1))
    four = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    errors, claimed, apart = [], [], []
    for _ in range(300):
        ideal, lens = _through_lens(pixels + rng.normal(0, 0.2, (60, 2)), camera)
        found = refine_pose(ideal, points, white, four, POSE, lens=lens)
        errors.append((POSE.inverse() @ found.base_from_camera).log())
        claimed.append(found.covariance)
        apart.append(np.median(found.residual_px))
    true, spread = np.cov(np.array(errors).T), np.mean(claimed, 0)
    turn = POSE.rotation_matrix()
    spread[:3, :3] = turn.T @ spread[:3, :3] @ turn
    return np.diag(true) / np.diag(spread), float(np.mean(apart))


def test_errors_are_those_of_the_image_whatever_the_lens() -> None:
    plain, barrel = many_runs(WIDE), many_runs(BARREL)
    np.testing.assert_allclose(barrel[0], plain[0], rtol=0.1)
    assert barrel[1] == pytest.approx(plain[1], rel=0.02)


def test_without_distortion_nothing_is_calculated() -> None:
    pixels = np.random.default_rng(0).uniform(0, 400, (9, 2))
    ideal, lens = _through_lens(pixels, WIDE)
    assert ideal is pixels
    assert lens is None


def test_depths_move_landmarks_in_the_image_of_a_distorted_lens(
    hall: Recording, hall_maps: SceneMaps, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = hall.test[1]
    lens = replace(frame.camera, distortion=(-0.25, 0.0, 0.0, 0.0))
    v, u = np.mgrid[0 : lens.height, 0 : lens.width]
    source = frame.camera.project(lens.unproject(np.stack([u, v], -1))).astype(np.float32)
    image = cv2.remap(frame.read_image(), source, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    asked: list[tuple[Array, Array, Array, Array, Camera]] = []
    given: list[Array] = []
    monkeypatch.setattr(
        module, "_shift_px", lambda *words: asked.append(words) or _shift_px(*words)
    )
    monkeypatch.setattr(
        module, "whitening", lambda *words: given.append(words[4]) or whitening(*words)
    )
    found = Localizer(hall_maps).localize(image, lens)
    assert found.base_from_camera is not None
    assert frame.base_from_camera is not None
    assert pose_distance(found.base_from_camera, frame.base_from_camera)[0] < 0.01
    points, moves, turn, shift, camera = asked[-1]
    assert camera.distortion == lens.distortion
    local = points @ turn.T + shift
    true = camera.project(local + 1e-4 * moves @ turn.T) - camera.project(local)
    np.testing.assert_allclose(
        given[-1], 1e4 * true, rtol=0.05, atol=0.02 * np.abs(true).max() * 1e4
    )


def hypothesis(inliers: int, matched: int, looked_for: int) -> Hypothesis:
    share = inliers / looked_for
    planned = min(looked_for, 900)
    kind = {"aligned": True, "matched": matched, "planned": planned}
    return Hypothesis(0, POSE, None, inliers, share, **kind)  # type: ignore[arg-type]


def test_support_is_that_of_the_docstring() -> None:
    # A half of 800 found, 4 of 5 of those where they should be: 0.4 * 0.8^2 * sqrt(0.4 * 800).
    assert hypothesis(320, 400, 800).support == pytest.approx(0.4 * 0.64 * np.sqrt(320))
    # Looking for more of the same does not make a pose more believable.
    once, thrice = hypothesis(45, 90, 900), hypothesis(135, 270, 2700)
    assert thrice.support == pytest.approx(once.support)
    assert hypothesis(45, 60, 900).support > once.support
    assert hypothesis(45, 90, 600).support > once.support
