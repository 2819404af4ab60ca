"""Landmarks: slants, warps and visibility, against closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.geometry.camera import Camera
from evercal.mapping.landmarks import (
    BORDER_PX,
    Landmarks,
    detect,
    project_surface,
    slopes,
)
from evercal.typing import Array

PLAIN = Camera(320, 240, 262.0, 259.0, 161.0, 118.0)
DISTORTED = Camera(320, 240, 262.0, 259.0, 161.0, 118.0, (-0.2, 0.06, 0.001, -0.002))


def on_a_plane(camera: Camera, normal: Array, pixels: Array) -> Landmarks:
    """Landmarks of the plane normal . x = 1, camera frame, with exact slopes."""

    def inverse_depth(at: Array) -> Array:
        return camera.unproject(at) @ normal

    steps = np.array([[2.0, 0], [0, 2.0]])
    beside = [
        (inverse_depth(pixels + step) - inverse_depth(pixels)) / 2 for step in steps
    ]
    n = len(pixels)
    return Landmarks(pixels, inverse_depth(pixels), np.stack(beside, -1), np.ones(n))


def spots() -> Array:
    u, v = np.meshgrid(np.arange(30, 300, 30), np.arange(30, 220, 30))
    return np.stack([u, v], -1).reshape(-1, 2).astype(float)


ROTATION = Rotation.from_rotvec([0.05, -0.2, 0.1]).as_matrix()
TRANSLATION = np.array([0.35, -0.2, 0.2])


@pytest.mark.parametrize("camera", [PLAIN, DISTORTED], ids=["plain", "distorted"])
def test_patches_warp_like_a_slanted_plane(camera: Camera) -> None:
    normal = np.array([0.15, -0.1, 0.5])
    marks = on_a_plane(camera, normal, spots())
    surface = marks.surface(camera)
    # All three points lie on it.
    np.testing.assert_allclose(surface @ normal, 1, atol=1e-9)
    which, pixels, affines = project_surface(surface, ROTATION, TRANSLATION, camera)
    assert len(which) > 40

    def projected(at: Array) -> Array:
        ray = camera.unproject(at)
        return camera.project(
            (ray / (ray @ normal)[:, None]) @ ROTATION.T + TRANSLATION
        )

    at = marks.pixels[which]
    np.testing.assert_allclose(pixels, projected(at), atol=1e-6)
    for column, step in enumerate(np.eye(2)):
        # Tangents are two pixels long, so perspective changes them a little.
        slope = (projected(at + 2 * step) - projected(at)) / 2
        np.testing.assert_allclose(affines[:, :, column], slope, atol=1e-6)
        centred = (projected(at + 0.01 * step) - projected(at - 0.01 * step)) / 0.02
        np.testing.assert_allclose(affines[:, :, column], centred, atol=0.03)
    # A plane parallel to the image has another warp.
    flat = Landmarks(marks.pixels, marks.inverse_depth, 0 * marks.slope, marks.sigma)
    _, _, other = project_surface(flat.surface(camera), ROTATION, TRANSLATION, camera)
    assert np.abs(np.median(other, 0) - np.median(affines, 0)).max() > 0.03


def test_landmarks_behind_outside_or_too_slanted_are_not_visible() -> None:
    marks = on_a_plane(PLAIN, np.array([0, 0, 0.5]), spots())
    surface = marks.surface(PLAIN)
    eye = np.eye(3)
    visible, pixels, affines = project_surface(surface, eye, np.zeros(3), PLAIN)
    assert visible.tolist() == list(range(len(marks)))
    np.testing.assert_allclose(pixels, marks.pixels, atol=1e-9)
    np.testing.assert_allclose(
        affines, np.broadcast_to(np.eye(2), affines.shape), atol=1e-9
    )
    # Behind the camera, and at its centre.
    for forward in (-2.5, -2.0):
        which, _, _ = project_surface(surface, eye, np.array([0, 0, forward]), PLAIN)
        assert len(which) == 0
    # Looking away.
    back = Rotation.from_rotvec([0, np.pi, 0]).as_matrix()
    assert len(project_surface(surface, back, np.zeros(3), PLAIN)[0]) == 0
    # Outside the image or within its margin.
    shift = np.array([0.9, 0.4, 0])
    which, pixels, _ = project_surface(surface, eye, shift, PLAIN)
    at = PLAIN.project(surface[0] + shift)
    low = BORDER_PX
    high = np.array([320, 240]) - 1 - BORDER_PX
    expected = [i for i, p in enumerate(at) if (p > low).all() and (p < high).all()]
    assert 0 < len(which) < len(marks)
    assert which.tolist() == expected
    np.testing.assert_allclose(pixels, at[expected])
    # Five times as large, and five times as small.
    assert len(project_surface(surface, eye, np.array([0, 0, -1.2]), PLAIN)[0]) == 0
    assert len(project_surface(surface, eye, np.array([0, 0, 3.0]), PLAIN)[0]) == 0
    assert len(project_surface(surface, eye, np.array([0, 0, 1.5]), PLAIN)[0]) > 0
    # Mirrored, as seen from behind.
    mirrored = surface * [1, 1, 1]
    mirrored[1:] = 2 * surface[0] - surface[1:]
    mirrored[2] = surface[2]
    assert len(project_surface(mirrored, eye, np.zeros(3), PLAIN)[0]) == 0


@pytest.mark.parametrize("most", [1, 20, 400])
def test_at_most_so_many_patches_are_evenly_spread(most: int) -> None:
    surface = on_a_plane(DISTORTED, np.array([0.15, -0.1, 0.5]), spots()).surface(
        DISTORTED
    )
    surface[1:, ::5] = surface[0, ::5]  # patches without an area are never visible
    which, *others = project_surface(surface, ROTATION, TRANSLATION, DISTORTED)
    some, *fewer = project_surface(surface, ROTATION, TRANSLATION, DISTORTED, most)
    assert 1 <= len(some) <= most
    assert set(some) <= set(which)
    for whole, part in zip(others, fewer, strict=True):
        np.testing.assert_allclose(part, whole[np.isin(which, some)], atol=1e-12)
    assert np.diff(some).max(initial=0) <= 3 * max(1, surface.shape[1] / most)
    assert most < len(which) or len(some) == len(which)


def test_slopes_of_a_plane_are_exact_inside() -> None:
    grid = (30, 40)
    cell = 8.0
    row, column = np.mgrid[0:30, 0:40]
    field = 0.5 + 0.003 * cell * column - 0.002 * cell * row
    result = slopes(field.ravel(), grid, cell).reshape(30, 40, 2)[5:-5, 5:-5]
    np.testing.assert_allclose(
        result, np.broadcast_to([0.003, -0.002], result.shape), atol=1e-6
    )
    # One wrong cell has no effect.
    corrupted = field.copy()
    corrupted[15, 20] = 4.0
    again = slopes(corrupted.ravel(), grid, cell).reshape(30, 40, 2)[5:-5, 5:-5]
    np.testing.assert_allclose(again, result, atol=2e-3)


def test_most_textured_pixel_of_every_cell_is_detected() -> None:
    rng = np.random.default_rng(0)
    grey = np.full((96, 128), 90, np.uint8)
    textured = [(2, 3), (5, 7), (8, 1)]
    for i, j in textured:
        grey[8 * i : 8 * i + 8, 8 * j : 8 * j + 8] = rng.integers(0, 255, (8, 8))
    pixels, cells = detect(grey, (12, 16), 8.0)
    assert {16 * i + j for i, j in textured} <= set(cells.tolist())
    # The 5x5 window includes texture of neighbouring cells.
    near = {
        16 * (i + a) + j + b
        for i, j in textured
        for a in (-1, 0, 1)
        for b in (-1, 0, 1)
    }
    assert set(cells.tolist()) <= near
    assert len(set(cells.tolist())) == len(cells)
    np.testing.assert_array_equal(cells, (pixels[:, 1] // 8) * 16 + pixels[:, 0] // 8)
    inside = (pixels >= BORDER_PX) & (pixels < np.array([128, 96]) - BORDER_PX)
    assert inside.all()
    empty = detect(np.full((96, 128), 90, np.uint8), (12, 16), 8.0)
    assert empty[0].shape == (0, 2)
    assert len(empty[1]) == 0


def test_taking_an_index_takes_all_fields() -> None:
    marks = on_a_plane(DISTORTED, np.array([0.1, 0, 0.5]), spots())
    some = marks.take(np.array([7, 3]))
    assert len(some) == 2
    for name in ("pixels", "inverse_depth", "slope", "sigma"):
        np.testing.assert_array_equal(getattr(some, name), getattr(marks, name)[[7, 3]])
