"""Rays of two lenses: what a rotation explains of their difference, and what it leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evercal.geometry import Camera
from evercal.geometry.rays import fit_rays, turn_by_lens

CAMERA = Camera(1280, 720, 900, 903, 650, 362, (0.01, 0.2, 4e-4, -4e-4, -0.3))
FISHEYE = Camera(640, 480, 300, 300, 320, 240, (0.01, 0.0, 0.0, 0.0), "fisheye")


def test_a_principal_point_is_a_rotation_of_the_rays() -> None:
    other = replace(CAMERA, cx=CAMERA.cx + 6)
    fit = fit_rays(CAMERA, other)
    # A larger cx sees the same pixel further left: turned to the right, about y.
    np.testing.assert_allclose(
        fit.own_from_other.as_rotvec(), [0, 6 / CAMERA.fx, 0], atol=1.5e-3
    )
    before = fit.own_from_other.inv().apply(fit.other)
    was = np.median(np.linalg.norm(before - fit.own, axis=1))
    assert np.median(fit.left_rad) < was / 5


def test_the_rotation_back_is_the_inverse() -> None:
    other = CAMERA.changed([0.01, 5, -3, 0.02, 0.1, 1e-3, -1e-3, 0.1])
    there = fit_rays(CAMERA, other).own_from_other
    back = fit_rays(other, CAMERA).own_from_other
    assert (there * back).magnitude() < 1e-9


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE])
def test_slopes_predict_the_rotation_of_small_changes(camera: Camera) -> None:
    slopes = turn_by_lens(camera, 5)
    for i, size in enumerate([1e-3, 0.5, 0.5, 1e-3, 1e-3, 1e-4, 1e-4, 1e-3]):
        change = np.zeros(8)
        change[i] = size
        turn = fit_rays(camera, camera.changed(change)).own_from_other
        np.testing.assert_allclose(turn.as_rotvec(), slopes @ change, atol=2e-6)


def test_other_image_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="differ in image size"):
        fit_rays(CAMERA, CAMERA.resized(640, 360))
