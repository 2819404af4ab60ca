"""How landmarks' own uncertainty enters, and what a pose is accepted by."""

from __future__ import annotations

import numpy as np
import pytest

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.localization.alignment import _shift_px
from evercal.localization.query import Hypothesis

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
