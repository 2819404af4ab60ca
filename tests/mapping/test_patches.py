"""Patches are aligned at their true positions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

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
from evercal.typing import Array

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


def image(of: Picture, affine: Array, shift: Array) -> Array:
    """An image with the value of the function at x in pixel A x + b."""
    back = np.linalg.inv(affine)
    return of((pixels() - shift) @ back.T).astype(np.float32)


def spots(count: int = 60, margin: int = 35) -> Array:
    rng = np.random.default_rng(1)
    low = np.array([margin, margin])
    high = np.array([WIDTH, HEIGHT]) - margin
    return np.round(rng.uniform(low, high, (count, 2)))


AFFINES = {
    "shifted": np.eye(2),
    "rotated": np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]),
    "sheared": np.array([[1.1, 0.25], [-0.1, 0.85]]),
    "enlarged": 1.3 * np.eye(2),
}


def warped(affine: Array, at: Array) -> tuple[Array, Array]:
    """An image warped about its middle with a sub-pixel shift, and the pixels in it."""
    middle = np.array([WIDTH, HEIGHT]) / 2
    shift = middle - affine @ middle + [0.37, -0.61]
    return image(picture(0), affine, shift), at @ affine.T + shift


@pytest.mark.parametrize("name", AFFINES)
def test_warped_patch_is_aligned_to_a_twentieth_of_a_pixel(name: str) -> None:
    affine = AFFINES[name]
    at = spots()
    other, truth = warped(affine, at)
    patches = cut_patches(image(picture(0), np.eye(2), np.zeros(2)), at)
    start = truth + np.random.default_rng(2).uniform(-1.5, 1.5, truth.shape)
    affines = np.broadcast_to(affine, (len(at), 2, 2))
    aligned, correlation = align_patches(patches, other, start, affines, 12)
    error = np.linalg.norm(aligned - truth, axis=1)
    assert np.quantile(error, 0.95) < 0.05
    assert np.quantile(correlation, 0.05) > 0.99
    # Without the warp it is worse.
    if name != "shifted":
        plain = np.broadcast_to(np.eye(2), (len(at), 2, 2))
        _, without = align_patches(patches, other, start, plain, 12)
        assert np.median(without) < np.median(correlation) - 0.01


def test_gain_and_offset_have_no_effect() -> None:
    at = spots()
    plain = image(picture(0), np.eye(2), np.zeros(2))
    other, truth = warped(AFFINES["sheared"], at)
    affines = np.broadcast_to(AFFINES["sheared"], (len(at), 2, 2))
    reference = align_patches(cut_patches(plain, at), other, truth + 0.7, affines, 8)
    brighter = align_patches(
        cut_patches(plain, at), 0.4 * other + 90, truth + 0.7, affines, 8
    )
    for a, b in zip(reference, brighter, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)
    templates = cut_patches(3 * plain - 7, at).templates
    np.testing.assert_allclose(templates, cut_patches(plain, at).templates, atol=1e-3)
    np.testing.assert_allclose(templates.mean(2), 0, atol=1e-4)
    np.testing.assert_allclose(templates[:, 2].std(1), 1, atol=1e-3)
    assert templates.shape == (len(at), 3, SIDE**2)


def test_patches_of_another_image_do_not_fit() -> None:
    at = spots()
    patches = cut_patches(image(picture(0), np.eye(2), np.zeros(2)), at)
    affines = np.broadcast_to(np.eye(2), (len(at), 2, 2))
    unrelated = image(picture(77), np.eye(2), np.zeros(2))
    _, correlation = align_patches(patches, unrelated, at, affines, 12)
    assert np.mean(correlation > 0.8) < 0.2
    for level in (90, 200, 252, 254.75):
        blank = np.full((HEIGHT, WIDTH), level, np.float32)
        aligned, correlation = align_patches(patches, blank, at, affines, 4)
        assert np.abs(correlation).max() < 0.1
        assert np.isfinite(aligned).all()


def test_step_of_one_patch_is_that_of_least_squares() -> None:
    plain = image(picture(3), np.eye(2), np.zeros(2))
    at = np.array([[60.0, 50.0]])
    patches = cut_patches(plain, at)
    affine = AFFINES["sheared"]
    other = image(picture(3), affine, np.array([10.3, 14.2]))
    truth = at @ affine.T + [10.3, 14.2]
    start = truth + np.array([0.4, -0.3])
    aligned, _ = align_patches(patches, other, start, affine[None], 1)

    def standardised(values: Array) -> Array:
        return (values - values.mean()) / (values.std() + 1e-3)

    steps = [(x, y) for y in range(-5, 6) for x in range(-5, 6)]
    template = [plain[50 + y, 60 + x] for x, y in steps]
    right = [plain[50 + y, 61 + x] - plain[50 + y, 59 + x] for x, y in steps]
    down = [plain[51 + y, 60 + x] - plain[49 + y, 60 + x] for x, y in steps]
    slope = np.stack([right, down], -1) / 2
    slope /= np.std(template) + 1e-3

    def bilinear(u: float, v: float) -> float:
        i = int(np.floor(v))
        j = int(np.floor(u))
        a = v - i
        b = u - j
        top = (1 - b) * other[i, j] + b * other[i, j + 1]
        return (1 - a) * top + a * ((1 - b) * other[i + 1, j] + b * other[i + 1, j + 1])

    values = [bilinear(*(start[0] + affine @ step)) for step in np.array(steps, float)]
    difference = standardised(np.array(values)) - standardised(np.array(template))
    step, *_ = np.linalg.lstsq(slope, difference, rcond=None)
    np.testing.assert_allclose(aligned[0], start[0] - affine @ step, atol=0.01)


def test_coarse_to_fine_alignment_has_a_larger_reach() -> None:
    at = spots(margin=45)
    plain = image(picture(5), np.eye(2), np.zeros(2))
    other = image(picture(5), np.eye(2), np.array([8.3, -6.6]))
    truth = at + np.array([8.3, -6.6])
    pyramid = image_pyramid(plain, 3)
    levels = [cut_patches(pyramid[i], to_level(at, i)) for i in range(3)]
    affines = np.broadcast_to(np.eye(2), (len(at), 2, 2))
    others = image_pyramid(other, 3)
    steps = ((2, 10), (1, 6), (0, 6))
    aligned, correlation = align_down(levels, others, at, affines, steps)
    good = np.linalg.norm(aligned - truth, axis=1) < 0.05
    assert good.mean() > 0.8
    assert np.median(correlation[good]) > 0.99
    aligned, _ = align_down(levels, others, at, affines, ((0, 22),))
    assert np.mean(np.linalg.norm(aligned - truth, axis=1) < 0.05) < good.mean() - 0.2


def test_many_patches_are_aligned_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    at = spots(50)
    other, truth = warped(AFFINES["rotated"], at)
    patches = cut_patches(image(picture(0), np.eye(2), np.zeros(2)), at)
    affines = np.broadcast_to(AFFINES["rotated"], (len(at), 2, 2))
    whole = align_patches(patches, other, truth + 0.5, affines, 3)
    monkeypatch.setattr("evercal.mapping.patches._MOST_ROWS", 8)
    parts = align_patches(patches, other, truth + 0.5, affines, 3)
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)
    empty = align_patches(patches.take(slice(0)), other, truth[:0], affines[:0], 3)
    assert [len(part) for part in empty] == [0, 0]


@pytest.mark.parametrize("level", [0, 1, 2])
def test_levels_have_inverse_and_consistent_pixels(level: int) -> None:
    at = spots()
    np.testing.assert_allclose(from_level(to_level(at, level), level), at, atol=1e-12)
    np.testing.assert_allclose(to_level(from_level(at, level), level), at, atol=1e-12)
    # The value of a ramp is the column of level 0.
    ramp = np.broadcast_to(np.arange(WIDTH, dtype=np.float32), (HEIGHT, WIDTH))
    shown = image_pyramid(ramp, 3)[level]
    assert shown.shape == (HEIGHT >> level, WIDTH >> level)
    pixel = np.stack([shown[3], np.full(shown.shape[1], 0.0)], -1)
    np.testing.assert_allclose(
        to_level(pixel, level)[:, 0], np.arange(shown.shape[1]), atol=1e-4
    )


def test_pyramids_of_odd_sizes_have_consistent_pixels() -> None:
    ramp = np.broadcast_to(np.arange(101, dtype=np.float32), (77, 101))
    halves = image_pyramid(ramp, 3)
    assert [level.shape for level in halves] == [(77, 101), (38, 50), (19, 25)]
    np.testing.assert_allclose(halves[2][0], 4 * np.arange(25) + 1.5, atol=1e-4)


def test_whitening_makes_errors_independent() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(20, 2, 2)) / 10
    inverse_hessian = root @ root.transpose(0, 2, 1) + 1e-4 * np.eye(2)
    affines = np.eye(2) + 0.3 * rng.normal(size=(20, 2, 2))
    white = whitening(affines, inverse_hessian, 0.1, 0.8).transpose(2, 0, 1)
    spread = affines @ inverse_hessian @ affines.transpose(0, 2, 1) + 0.01 * np.eye(2)
    unit = white @ (0.64 * spread) @ white.transpose(0, 2, 1)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(2), unit.shape), atol=1e-6)


def test_whitening_is_the_root_of_the_inverse_covariance() -> None:
    """Without and with an error along one line."""
    rng = np.random.default_rng(0)
    affines = rng.normal(0, 0.2, (7, 2, 2)) + np.eye(2)
    root = rng.normal(0, 0.3, (7, 2, 2))
    hessian = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    line = rng.normal(0, 0.5, (7, 2))
    for moved in (None, line):
        white = whitening(affines, hessian, 0.1, 0.8, moved)
        for i in range(7):
            spread = affines[i] @ hessian[i] @ affines[i].T + 0.01 * np.eye(2)
            covariance = 0.64 * spread + (
                0 if moved is None else np.outer(line[i], line[i])
            )
            root = np.linalg.cholesky(np.linalg.inv(covariance)).T
            np.testing.assert_allclose(white[:, :, i], root, atol=1e-9)


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
