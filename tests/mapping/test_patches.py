"""Patches are aligned at their true positions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from evercal.mapping.patches import (
    SIDE,
    Patches,
    align_down,
    align_patches,
    cut_patches,
    from_level,
    image_pyramid,
    to_level,
    whitening,
)
from evercal.typing import Array, BoolArray

Picture = Callable[[Array], Array]
HEIGHT = 120
WIDTH = 160


def picture(seed: int, shortest_px: float = 6.0) -> Picture:
    """A smooth random function of pixels (..., 2): a sum of waves, 0 to 255."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, 40)
    length = rng.uniform(shortest_px, 40, 40)
    wave = 2 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    phase = rng.uniform(0, 2 * np.pi, 40)
    return lambda where: 128 + 25 * np.cos(where @ wave.T + phase).sum(-1) / np.sqrt(20)


def pixels() -> Array:
    """(h, w, 2) of an image."""
    return np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).astype(float)


STILL = np.eye(2)


def image(seed: int = 0, affine: Array = STILL, shift: Array | float = 0.0) -> Array:
    """An image with the value of a picture at x in pixel A x + b."""
    back = np.linalg.inv(affine)
    return picture(seed)((pixels() - shift) @ back.T).astype(np.float32)


def spots(count: int = 60, margin: int = 35) -> Array:
    rng = np.random.default_rng(1)
    low = np.array([margin, margin])
    high = np.array([WIDTH, HEIGHT]) - margin
    return np.round(rng.uniform(low, high, (count, 2)))


SPOTS = spots()
PATCHES = cut_patches(image(), SPOTS)
AFFINES = {
    "shifted": STILL,
    "rotated": np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]),
    "sheared": np.array([[1.1, 0.25], [-0.1, 0.85]]),
    "enlarged": 1.3 * STILL,
}


def warped(affine: Array) -> tuple[Array, Array]:
    """An image warped about its middle with a sub-pixel shift, and the spots in it."""
    middle = np.array([WIDTH, HEIGHT]) / 2
    shift = middle - affine @ middle + [0.37, -0.61]
    return image(0, affine, shift), SPOTS @ affine.T + shift


def aligned(
    patches: Patches, other: Array, start: Array, affine: Array, iterations: int
) -> tuple[Array, Array]:
    """`align_patches` with one affine for all."""
    affines = np.broadcast_to(affine, (len(start), 2, 2))
    return align_patches(patches, other, start, affines, iterations)


@pytest.mark.parametrize("name", AFFINES)
def test_warped_patch_is_aligned_to_a_twentieth_of_a_pixel(name: str) -> None:
    affine = AFFINES[name]
    other, truth = warped(affine)
    start = truth + np.random.default_rng(2).uniform(-1.5, 1.5, truth.shape)
    result, correlation = aligned(PATCHES, other, start, affine, 12)
    error = np.linalg.norm(result - truth, axis=1)
    assert np.quantile(error, 0.95) < 0.05
    assert np.quantile(correlation, 0.05) > 0.99
    # Without the warp it is worse.
    if name != "shifted":
        _, without = aligned(PATCHES, other, start, STILL, 12)
        assert np.median(without) < np.median(correlation) - 0.01


def test_gain_and_offset_have_no_effect() -> None:
    affine = AFFINES["sheared"]
    other, truth = warped(affine)
    reference = aligned(PATCHES, other, truth + 0.7, affine, 8)
    brighter = aligned(PATCHES, 0.4 * other + 90, truth + 0.7, affine, 8)
    for a, b in zip(reference, brighter, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)
    templates = cut_patches(3 * image() - 7, SPOTS).templates
    np.testing.assert_allclose(templates, PATCHES.templates, atol=1e-3)
    np.testing.assert_allclose(templates.mean(2), 0, atol=1e-4)
    np.testing.assert_allclose(templates[:, 2].std(1), 1, atol=1e-3)
    assert templates.shape == (len(SPOTS), 3, SIDE**2)


def test_patches_of_another_image_do_not_fit() -> None:
    _, correlation = aligned(PATCHES, image(77), SPOTS, STILL, 12)
    assert np.mean(correlation > 0.8) < 0.2
    for level in (90, 200, 252, 254.75):
        blank = np.full((HEIGHT, WIDTH), level, np.float32)
        result, correlation = aligned(PATCHES, blank, SPOTS, STILL, 4)
        assert np.abs(correlation).max() < 0.1
        assert np.isfinite(result).all()


def test_step_of_one_patch_is_that_of_least_squares() -> None:
    plain = image(3)
    at = np.array([[60.0, 50.0]])
    affine = AFFINES["sheared"]
    shift = np.array([10.3, 14.2])
    other = image(3, affine, shift)
    start = at @ affine.T + shift + [0.4, -0.3]
    result, _ = aligned(cut_patches(plain, at), other, start, affine, 1)

    def standardised(values: Array) -> Array:
        return (values - values.mean()) / (values.std() + 1e-3)

    v, u = np.mgrid[45:56, 55:66]
    template = plain[v, u].ravel()
    right = plain[v, u + 1] - plain[v, u - 1]
    down = plain[v + 1, u] - plain[v - 1, u]
    slope = np.stack([right, down], -1).reshape(-1, 2) / 2
    slope /= template.std() + 1e-3
    sampled = start[0] + (np.stack([u, v], -1).reshape(-1, 2) - at) @ affine.T
    # Bilinear interpolation.
    values = map_coordinates(other, sampled.T[::-1], order=1)
    difference = standardised(values) - standardised(template)
    step, *_ = np.linalg.lstsq(slope, difference, rcond=None)
    np.testing.assert_allclose(result[0], start[0] - affine @ step, atol=0.01)


def test_coarse_to_fine_alignment_has_a_larger_reach() -> None:
    at = spots(margin=45)
    shift = np.array([8.3, -6.6])
    pyramid = image_pyramid(image(5), 3)
    levels = [cut_patches(pyramid[i], to_level(at, i)) for i in range(3)]
    affines = np.broadcast_to(STILL, (len(at), 2, 2))
    others = image_pyramid(image(5, STILL, shift), 3)

    def good(steps: tuple[tuple[int, int], ...]) -> tuple[BoolArray, Array]:
        result, correlation = align_down(levels, others, at, affines, steps)
        return np.linalg.norm(result - at - shift, axis=1) < 0.05, correlation

    down, correlation = good(((2, 10), (1, 6), (0, 6)))
    assert down.mean() > 0.8
    assert np.median(correlation[down]) > 0.99
    assert good(((0, 22),))[0].mean() < down.mean() - 0.2


def test_many_patches_are_aligned_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    affine = AFFINES["rotated"]
    other, truth = warped(affine)
    whole = aligned(PATCHES, other, truth + 0.5, affine, 3)
    monkeypatch.setattr("evercal.mapping.patches._MOST_ROWS", 8)
    parts = aligned(PATCHES, other, truth + 0.5, affine, 3)
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)
    empty = aligned(PATCHES.take(slice(0)), other, truth[:0], affine, 3)
    assert [len(part) for part in empty] == [0, 0]


@pytest.mark.parametrize("level", [0, 1, 2])
def test_levels_have_inverse_and_consistent_pixels(level: int) -> None:
    for there, back in ((to_level, from_level), (from_level, to_level)):
        again = back(there(SPOTS, level), level)
        np.testing.assert_allclose(again, SPOTS, atol=1e-12)
    # The value of a ramp is the column of level 0.
    ramp = np.broadcast_to(np.arange(WIDTH, dtype=np.float32), (HEIGHT, WIDTH))
    shown = image_pyramid(ramp, 3)[level]
    assert shown.shape == (HEIGHT >> level, WIDTH >> level)
    columns = np.arange(shown.shape[1])
    pixel = np.stack([shown[3], 0 * columns], -1)
    np.testing.assert_allclose(to_level(pixel, level)[:, 0], columns, atol=1e-4)


def test_pyramids_of_odd_sizes_have_consistent_pixels() -> None:
    ramp = np.broadcast_to(np.arange(101, dtype=np.float32), (77, 101))
    halves = image_pyramid(ramp, 3)
    assert [level.shape for level in halves] == [(77, 101), (38, 50), (19, 25)]
    np.testing.assert_allclose(halves[2][0], 4 * np.arange(25) + 1.5, atol=1e-4)


def test_whitening_is_the_root_of_the_inverse_covariance() -> None:
    """Without and with an error along one line."""
    rng = np.random.default_rng(0)
    affines = rng.normal(0, 0.2, (7, 2, 2)) + np.eye(2)
    root = rng.normal(0, 0.3, (7, 2, 2))
    hessian = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    line = rng.normal(0, 0.5, (7, 2))
    spread = affines @ hessian @ affines.transpose(0, 2, 1) + 0.01 * STILL
    for moved, size in ((None, 0), (line, 1)):
        white = whitening(affines, hessian, 0.1, 0.8, moved)
        covariance = 0.64 * spread + size * line[:, :, None] * line[:, None]
        root = np.linalg.cholesky(np.linalg.inv(covariance))
        np.testing.assert_allclose(white.T, root, atol=1e-9)


def test_no_pixels_give_no_patches() -> None:
    empty = cut_patches(np.zeros((40, 40), np.float32), np.zeros((0, 2)))
    assert len(empty.templates) == 0
    assert Patches.joined([empty, empty]).templates.shape == empty.templates.shape


def test_a_flat_patch_beside_a_corner_has_a_hessian() -> None:
    """The slopes of its first pixel are parallel and 10^5 times as large as the damping."""
    flat = np.zeros((40, 40), np.float32)
    flat[14, 15] = flat[15, 14] = 200
    patches = cut_patches(flat, np.array([[20.0, 20.0]]))
    assert np.isfinite(patches.inverse_hessian).all()
