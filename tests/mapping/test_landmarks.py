"""Landmarks: slants, warps and visibility, against closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.geometry.camera import Camera
from evercal.mapping.landmarks import (
    BORDER_PX,
    Landmarks,
    ProjectedPatches,
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

    here = inverse_depth(pixels)
    beside = np.stack([inverse_depth(pixels + step) for step in 2 * np.eye(2)], -1)
    slope = (beside - here[:, None]) / 2
    return Landmarks(pixels, here, slope, np.ones(len(pixels)))


def spots() -> Array:
    u, v = np.meshgrid(np.arange(30, 300, 30), np.arange(30, 220, 30))
    return np.stack([u, v], -1).reshape(-1, 2).astype(float)


ROTATION = Rotation.from_rotvec([0.05, -0.2, 0.1]).as_matrix()
TRANSLATION = np.array([0.35, -0.2, 0.2])
SLANTED = np.array([0.15, -0.1, 0.5])


@pytest.mark.parametrize("camera", [PLAIN, DISTORTED], ids=["plain", "distorted"])
def test_patches_warp_like_a_slanted_plane(camera: Camera) -> None:
    marks = on_a_plane(camera, SLANTED, spots())
    surface = marks.surface(camera)
    # All three points lie on it.
    np.testing.assert_allclose(surface @ SLANTED, 1, atol=1e-9)
    which, pixels, affines = project_surface(surface, ROTATION, TRANSLATION, camera)
    assert len(which) > 40

    def projected(at: Array) -> Array:
        ray = camera.unproject(at)
        points = ray / (ray @ SLANTED)[:, None]
        return camera.project(points @ ROTATION.T + TRANSLATION)

    at = marks.pixels[which]
    np.testing.assert_allclose(pixels, projected(at), atol=1e-6)
    for column, step in zip(affines.transpose(2, 0, 1), np.eye(2), strict=True):
        # Tangents are two pixels long, so perspective changes them a little.
        slope = (projected(at + 2 * step) - projected(at)) / 2
        np.testing.assert_allclose(column, slope, atol=1e-6)
        centred = (projected(at + 0.01 * step) - projected(at - 0.01 * step)) / 0.02
        np.testing.assert_allclose(column, centred, atol=0.03)
    # A plane parallel to the image has another warp.
    flat = Landmarks(marks.pixels, marks.inverse_depth, 0 * marks.slope, marks.sigma)
    _, _, other = project_surface(flat.surface(camera), ROTATION, TRANSLATION, camera)
    assert np.abs(np.median(other, 0) - np.median(affines, 0)).max() > 0.03


def test_landmarks_behind_outside_or_too_slanted_are_not_visible() -> None:
    marks = on_a_plane(PLAIN, np.array([0, 0, 0.5]), spots())
    surface = marks.surface(PLAIN)

    def shown(
        x: float = 0, y: float = 0, z: float = 0, points: Array = surface
    ) -> ProjectedPatches:
        return project_surface(points, np.eye(3), np.array([x, y, z]), PLAIN)

    visible, pixels, affines = shown()
    assert visible.tolist() == list(range(len(marks)))
    np.testing.assert_allclose(pixels, marks.pixels, atol=1e-9)
    np.testing.assert_allclose(affines - np.eye(2), 0, atol=1e-9)
    # Behind the camera, at its centre, five times as large, and five times as small.
    for forward in (-2.5, -2.0, -1.2, 3.0):
        assert len(shown(z=forward).landmark) == 0
    assert len(shown(z=1.5).landmark) > 0
    # Looking away.
    assert len(shown(points=surface * [-1, 1, -1]).landmark) == 0
    # Outside the image or within its margin.
    which, pixels, _ = shown(0.9, 0.4)
    at = PLAIN.project(surface[0] + [0.9, 0.4, 0])
    high = np.array([320, 240]) - 1 - BORDER_PX
    expected = np.flatnonzero(((at > BORDER_PX) & (at < high)).all(1))
    assert 0 < len(which) < len(marks)
    np.testing.assert_array_equal(which, expected)
    np.testing.assert_allclose(pixels, at[expected])
    # Mirrored, as seen from behind.
    mirrored = surface.copy()
    mirrored[1] = 2 * surface[0] - surface[1]
    assert len(shown(points=mirrored).landmark) == 0


@pytest.mark.parametrize("most", [1, 20, 400])
def test_at_most_so_many_patches_are_evenly_spread(most: int) -> None:
    surface = on_a_plane(DISTORTED, SLANTED, spots()).surface(DISTORTED)
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
    row, column = np.mgrid[0:30, 0:40]
    field = 0.5 + 8.0 * (0.003 * column - 0.002 * row)
    # One wrong cell has no effect.
    corrupted = field.copy()
    corrupted[15, 20] = 4.0
    for values, atol in ((field, 1e-6), (corrupted, 2e-3)):
        result = slopes(values.ravel(), (30, 40), 8.0).reshape(30, 40, 2)
        np.testing.assert_allclose(result[5:-5, 5:-5] - [0.003, -0.002], 0, atol=atol)


def test_most_textured_pixel_of_every_cell_is_detected() -> None:
    rng = np.random.default_rng(0)
    grey = np.full((96, 128), 90, np.uint8)
    textured = [(2, 3), (5, 7), (8, 1)]
    for i, j in textured:
        grey[8 * i : 8 * i + 8, 8 * j : 8 * j + 8] = rng.integers(0, 255, (8, 8))
    pixels, cells = detect(grey, (12, 16), 8.0)
    assert {16 * i + j for i, j in textured} <= set(cells.tolist())
    # The 5x5 window includes texture of neighbouring cells.
    rows, columns = np.array(textured).T[..., None]
    distance = np.maximum(abs(cells // 16 - rows), abs(cells % 16 - columns))
    assert distance.min(0).max() <= 1
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
    for name, values in vars(marks).items():
        np.testing.assert_array_equal(getattr(some, name), values[[7, 3]])
