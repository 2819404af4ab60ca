"""Views through other lenses show scene points where their intrinsics project them."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from benchmarks.lenses import LENSES, ROLLS_DEG, View, rolled
from evercal.errors import InputError
from evercal.geometry import Camera

OWN = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
VIEWS = LENSES | {f"roll {deg}": partial(rolled, roll_deg=deg) for deg in ROLLS_DEG}


def dotted(pixels: np.ndarray) -> np.ndarray:
    """An image of OWN with smooth white dots at pixels (n, 2)."""
    u, v = np.meshgrid(np.arange(OWN.width), np.arange(OWN.height))
    image = np.zeros(u.shape)
    for x, y in pixels:
        image += 255 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 2.5**2))
    return image.clip(0, 255).astype(np.uint8)[..., None].repeat(3, -1)


def centroid(image: np.ndarray, near: np.ndarray, radius: int) -> np.ndarray:
    """Centre of brightness (2,) within a radius of a pixel."""
    u, v = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    weight = image[..., 0] * (np.hypot(u - near[0], v - near[1]) < radius).astype(float)
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


@pytest.mark.parametrize("name", VIEWS)
def test_points_appear_where_the_true_camera_projects_them(name: str) -> None:
    view = VIEWS[name](OWN)
    # Points near the corners and the middle of the view, 2 m in front of the camera.
    at = np.array([[0.15, 0.2], [0.85, 0.15], [0.2, 0.85], [0.8, 0.8], [0.55, 0.45]])
    expected = at * [view.camera.width - 1, view.camera.height - 1]
    points = view.own_from_view.apply(2 * view.camera.unproject(expected))
    image = view.render(dotted(OWN.project(points)), OWN)
    assert image.shape == (view.camera.height, view.camera.width, 3)
    found = np.stack([centroid(image, pixel, 15) for pixel in expected])
    np.testing.assert_allclose(found, expected, atol=0.06)


def test_exact_views_keep_every_pixel() -> None:
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    exact = {
        "own camera": image,
        "centre crop": image[30:210, 40:280],
        "off-centre crop": image[:180, 80:],
        "roll 90": np.rot90(image, 1),
        "roll 180": np.rot90(image, 2),
        "roll 270": np.rot90(image, 3),
    }
    for name, expected in exact.items():
        np.testing.assert_array_equal(VIEWS[name](OWN).render(image, OWN), expected)
    half = cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA).astype(int)
    assert np.abs(LENSES["half size"](OWN).render(image, OWN) - half).max() <= 1


def test_a_view_wider_than_the_image_is_refused() -> None:
    image = np.zeros((240, 320, 3), np.uint8)
    for camera in (OWN.zoomed(0.99), replace(OWN, distortion=(-0.15, 0.0, 0.0, 0.0))):
        with pytest.raises(InputError, match="wider than the image"):
            View(camera).render(image, OWN)
