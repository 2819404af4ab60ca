"""Image pairs: corresponding pixels show the same surface point."""

import cv2
import numpy as np
import pytest

from evercal.simulation.box_room import BoxRoom
from training.pairs import (
    HEIGHT,
    WIDTH,
    RoomViews,
    cell_pixels,
    homography_pair,
    inside,
    photometric,
    random_homography,
    view_pair,
)

from .conftest import SEED

pytestmark = pytest.mark.slow("training", "src/evercal/features")


def hit(views: RoomViews, index: int, pixels: np.ndarray) -> np.ndarray:
    """Intersect the rays of pixels with the room, (n, 3)."""
    pose = views.base_from_camera[index]
    rays = views.cameras[index].unproject(pixels) @ pose.rotation_matrix().T
    return views.geometry.intersect(pose.translation_m, rays)[0]


@pytest.mark.parametrize(("first", "second"), [(0, 1), (1, 0), (2, 3), (4, 6), (7, 5)])
def test_rays_of_both_cameras_meet(views: RoomViews, first: int, second: int) -> None:
    pair = view_pair(views, first, second, np.random.default_rng(0))
    a, b = pair.pixels.astype(float)
    assert len(a) == len(b) > 20
    assert inside(a).all()
    assert inside(b).all()
    here = hit(views, first, a)
    there = hit(views, second, b)
    away = np.linalg.norm(here - views.base_from_camera[second].translation_m, axis=1)
    assert (np.linalg.norm(here - there, axis=1) < 0.011 * away + 1e-4).all()
    assert np.median(np.linalg.norm(here - there, axis=1)) < 1e-4
    assert np.abs(a - b).max() > 5  # the cameras differ
    np.testing.assert_array_equal(pair.images, views.images[[first, second]])


@pytest.mark.parametrize(("first", "second"), [(0, 1), (4, 6)])
def test_no_visible_point_is_missing(views: RoomViews, first: int, second: int) -> None:
    """Compare with a loop over all candidates that intersects the second camera's rays."""
    candidates = cell_pixels() + np.random.default_rng(3).uniform(-3.5, 3.5, (768, 2))
    points = hit(views, first, candidates)
    other = views.base_from_camera[second]
    camera = views.cameras[second]
    expected = []
    for candidate, point in zip(candidates, points, strict=True):
        local = other.inverse().apply(point)
        if local[2] < 0.05 or not inside(candidate[None])[0]:
            continue
        pixel = camera.project(local)
        if not inside(pixel[None])[0]:
            continue
        again = hit(views, second, pixel[None])[0]
        if np.linalg.norm(again - point) < 0.01 * np.linalg.norm(local):
            expected.append([candidate, pixel])
    actual = view_pair(views, first, second, np.random.default_rng(3)).pixels
    assert abs(len(expected) - actual.shape[1]) <= 2  # rays may touch an edge
    nearest = np.abs(np.array(expected)[:, None] - actual.transpose(1, 0, 2)[None]).max(
        (2, 3)
    )
    assert (nearest.min(1) < 1e-3).mean() > 0.98


def test_views_equal_direct_renderings(views: RoomViews) -> None:
    assert views.images.shape == (8, HEIGHT, WIDTH)
    assert len(views.cameras) == len(views.base_from_camera) == 8
    room = BoxRoom(SEED, texture_px=48)
    for i in (0, 3, 7):
        drawn = room.render(views.cameras[i], views.base_from_camera[i])
        np.testing.assert_array_equal(
            views.images[i], cv2.cvtColor(drawn, cv2.COLOR_RGB2GRAY)
        )
    eyes = views.base_from_camera.translation_m
    assert (np.abs(eyes[:, :2]) <= room.size_m[:2] / 2 - 0.3 + 1e-9).all()
    assert (eyes[:, 2] >= 0.3 - 1e-9).all()
    assert (eyes[:, 2] <= room.size_m[2] - 0.2 + 1e-9).all()
    # One focal length per anchor.
    focal = [camera.fx for camera in views.cameras]
    assert len(set(focal[:4])) == len(set(focal[4:])) == 1
    assert focal[0] != focal[4]


def test_homography_pair_shows_the_same_points() -> None:
    """The pictures are ramps, so grey values are coordinates."""
    side = 240
    ramp = np.tile(np.arange(side, dtype=np.uint8)[None], (side, 1))
    for seed in range(6):
        across, down = (
            homography_pair(picture, np.random.default_rng(seed))
            for picture in (ramp, ramp.T)
        )
        np.testing.assert_array_equal(across.pixels, down.pixels)
        first, second = across.pixels.astype(float)
        assert len(first) > 50
        assert inside(first).all()
        assert inside(second).all()
        maps = [
            random_homography(side, rng)
            for rng in [np.random.default_rng(seed)]
            for _ in "ab"
        ]
        truth = cv2.perspectiveTransform(first[None], maps[0])[0]
        back = cv2.perspectiveTransform(second[None], maps[1])[0]
        np.testing.assert_allclose(truth, back, atol=1e-2)
        # Away from the reflected border.
        clear = ((truth > 4) & (truth < side - 5)).all(1)
        for pair, axis in ((across, 0), (down, 1)):
            for image, pixels in zip(pair.images, (first, second), strict=True):
                where = pixels.astype(np.float32)[:, None]
                grey = image.astype(np.float32)
                captured = cv2.remap(grey, where, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
                error = captured.ravel()[clear] - truth[clear, axis]
                assert np.abs(error).max() < 1.5
                assert abs(error.mean()) < 0.15


def test_photometric_changes_do_not_shift_the_image() -> None:
    dot = np.full((41, 41), 40, np.uint8)
    dot[18:23, 18:23] = 220
    v, u = np.mgrid[0:41, 0:41] - 20.0
    for seed in range(60):
        actual = photometric(dot, np.random.default_rng(seed))
        assert actual.shape == dot.shape
        assert actual.dtype == np.uint8
        np.testing.assert_array_equal(
            actual, photometric(dot, np.random.default_rng(seed))
        )
        window = actual[8:33, 8:33].astype(float)
        weight = np.clip(window - np.median(window) - 25, 0, None)
        centre = [(weight * axis[8:33, 8:33]).sum() / weight.sum() for axis in (u, v)]
        assert np.abs(centre).max() < 0.3
