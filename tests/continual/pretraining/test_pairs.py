"""Pairs of images: the two pixels of a correspondence really show one surface point."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from evercal.continual.pretraining.pairs import (
    HEIGHT,
    WIDTH,
    RoomViews,
    cell_pixels,
    homography_pair,
    inside,
    leaf_picture,
    photometric,
    random_homography,
    room_views,
    view_pair,
)
from evercal.features.views import cell_centres
from evercal.simulation.box_room import BoxRoom

from .conftest import SEED


def hit(views: RoomViews, index: int, pixels: np.ndarray) -> np.ndarray:
    """(n, 3) room points that pixels of one view show."""
    pose = views.base_from_camera[index]
    rays = views.cameras[index].unproject(pixels) @ pose.rotation_matrix().T
    return views.geometry.intersect(pose.translation_m, rays)[0]


def grey_at(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    blurred = cv2.GaussianBlur(image, (0, 0), 1.5).astype(np.float32)
    where = pixels.astype(np.float32)[:, None]
    return cv2.remap(blurred, where, None, cv2.INTER_LINEAR).ravel()  # type: ignore[call-overload]


def test_cells_are_those_of_the_encoder() -> None:
    np.testing.assert_array_equal(cell_pixels(), cell_centres(HEIGHT, WIDTH, 8))


def test_inside_keeps_a_margin() -> None:
    pixels = np.array([[0, 0], [3.4, 50], [3.5, 3.5], [WIDTH - 4.5, HEIGHT - 4.5], [50, HEIGHT]])
    assert inside(pixels).tolist() == [False, False, True, True, False]
    assert inside(pixels, margin=0).tolist() == [True, True, True, True, False]


@pytest.mark.parametrize(("first", "second"), [(0, 1), (1, 0), (2, 3), (4, 6), (7, 5)])
def test_rays_of_both_cameras_meet_at_one_point(views: RoomViews, first: int, second: int) -> None:
    pair = view_pair(views, first, second, np.random.default_rng(0))
    a, b = pair.pixels.astype(float)
    assert len(a) == len(b) > 20
    assert inside(a).all()
    assert inside(b).all()
    here, there = hit(views, first, a), hit(views, second, b)
    away = np.linalg.norm(here - views.base_from_camera[second].translation_m, axis=1)
    assert (np.linalg.norm(here - there, axis=1) < 0.011 * away + 1e-4).all()
    assert np.median(np.linalg.norm(here - there, axis=1)) < 1e-4
    assert np.abs(a - b).max() > 5  # the camera did move
    np.testing.assert_array_equal(pair.images, views.images[[first, second]])


@pytest.mark.parametrize(("first", "second"), [(0, 1), (4, 6)])
def test_no_visible_point_is_left_out(views: RoomViews, first: int, second: int) -> None:
    """Slow twin: of all candidates, those that the second camera's own ray finds again."""
    candidates = cell_pixels() + np.random.default_rng(3).uniform(-3.5, 3.5, (768, 2))
    points = hit(views, first, candidates)
    other, camera = views.base_from_camera[second], views.cameras[second]
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
    found = view_pair(views, first, second, np.random.default_rng(3)).pixels
    assert abs(len(expected) - found.shape[1]) <= 2  # a ray may graze an edge
    nearest = np.abs(np.array(expected)[:, None] - found.transpose(1, 0, 2)[None]).max((2, 3))
    assert (nearest.min(1) < 1e-3).mean() > 0.98


def test_corresponding_pixels_look_alike(views: RoomViews) -> None:
    rng, values = np.random.default_rng(1), []
    for first, second in ((0, 1), (1, 2), (4, 5), (6, 7)):
        pair = view_pair(views, first, second, rng)
        values.append(np.stack([grey_at(*both) for both in zip(*vars(pair).values(), strict=True)]))
    a, b = np.concatenate(values, 1)
    assert np.corrcoef(a, b)[0, 1] > 0.95
    assert np.corrcoef(a, rng.permutation(b))[0, 1] < 0.3


def test_a_view_paired_with_itself_keeps_every_pixel_in_place(views: RoomViews) -> None:
    pair = view_pair(views, 3, 3, np.random.default_rng(0))
    np.testing.assert_allclose(pair.pixels[0], pair.pixels[1], atol=1e-3)
    candidates = cell_pixels() + np.random.default_rng(0).uniform(-3.5, 3.5, (768, 2))
    assert pair.pixels.shape[1] == inside(candidates).sum()


def test_views_are_what_the_rooms_own_cameras_see(views: RoomViews) -> None:
    assert views.images.shape == (8, HEIGHT, WIDTH)
    assert len(views.cameras) == len(views.base_from_camera) == 8
    room = BoxRoom(SEED, texture_px=48)
    for i in (0, 3, 7):
        drawn = room.render(views.cameras[i], views.base_from_camera[i])
        np.testing.assert_array_equal(views.images[i], cv2.cvtColor(drawn, cv2.COLOR_RGB2GRAY))
    eyes = views.base_from_camera.translation_m
    assert (np.abs(eyes[:, :2]) <= room.size_m[:2] / 2 - 0.3 + 1e-9).all()
    assert (eyes[:, 2] >= 0.3 - 1e-9).all()
    assert (eyes[:, 2] <= room.size_m[2] - 0.2 + 1e-9).all()
    # One focal length per anchor, another for the next.
    focal = [camera.fx for camera in views.cameras]
    assert len(set(focal[:4])) == len(set(focal[4:])) == 1
    assert focal[0] != focal[4]


def test_views_repeat_with_the_seed(coarse: Callable[[int], RoomViews], views: RoomViews) -> None:
    again = coarse(SEED)
    np.testing.assert_array_equal(again.images, views.images)
    np.testing.assert_array_equal(again.base_from_camera.matrix(), views.base_from_camera.matrix())
    assert room_views(SEED + 1, 1, 1).images.shape == (1, HEIGHT, WIDTH)


def test_a_homography_pair_shows_one_point_of_the_picture() -> None:
    """Ramps instead of a picture: their grey values are the coordinates."""
    side = 240
    ramp = np.tile(np.arange(side, dtype=np.uint8)[None], (side, 1))
    for seed in range(6):
        across, down = (
            homography_pair(picture, np.random.default_rng(seed)) for picture in (ramp, ramp.T)
        )
        np.testing.assert_array_equal(across.pixels, down.pixels)
        first, second = across.pixels.astype(float)
        assert len(first) > 50
        assert inside(first).all()
        assert inside(second).all()
        maps = [random_homography(side, rng) for rng in [np.random.default_rng(seed)] for _ in "ab"]
        truth = cv2.perspectiveTransform(first[None], maps[0])[0]
        back = cv2.perspectiveTransform(second[None], maps[1])[0]
        np.testing.assert_allclose(truth, back, atol=1e-2)
        clear = ((truth > 4) & (truth < side - 5)).all(1)  # away from the reflected border
        for pair, axis in ((across, 0), (down, 1)):
            for image, pixels in zip(pair.images, (first, second), strict=True):
                where = pixels.astype(np.float32)[:, None]
                seen = cv2.remap(image.astype(np.float32), where, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
                error = seen.ravel()[clear] - truth[clear, axis]
                assert np.abs(error).max() < 1.5
                assert abs(error.mean()) < 0.15


def test_homographies_differ_in_scale_and_turn() -> None:
    rng = np.random.default_rng(0)
    scales, angles = [], []
    for _ in range(100):
        m = random_homography(448, rng)
        across, start = cv2.perspectiveTransform(np.array([[[WIDTH, 0.0], [0.0, 0.0]]]), m)[0]
        scales.append(np.linalg.norm(across - start) / WIDTH)
        angles.append(np.arctan2(*(across - start)[::-1]))
        middle = cv2.perspectiveTransform(np.array([[[WIDTH / 2, HEIGHT / 2]]]), m)[0, 0]
        assert (np.abs(middle - 224) < 0.25 * 448).all()
    assert min(scales) < 0.75
    assert max(scales) > 1.4
    assert 0.15 < np.std(angles) < 0.5


def test_light_and_blur_repeat_with_the_generator_and_move_nothing() -> None:
    dot = np.full((41, 41), 40, np.uint8)
    dot[18:23, 18:23] = 220
    v, u = np.mgrid[0:41, 0:41] - 20.0
    for seed in range(60):
        found = photometric(dot, np.random.default_rng(seed))
        assert found.shape == dot.shape
        assert found.dtype == np.uint8
        np.testing.assert_array_equal(found, photometric(dot, np.random.default_rng(seed)))
        window = found[8:33, 8:33].astype(float)
        weight = np.clip(window - np.median(window) - 25, 0, None)
        centre = [(weight * axis[8:33, 8:33]).sum() / weight.sum() for axis in (u, v)]
        assert np.abs(centre).max() < 0.3


def test_light_changes_the_picture_but_not_beyond_recognition() -> None:
    picture = leaf_picture(np.random.default_rng(0), 160)
    likeness = []
    for seed in range(20):
        found = photometric(picture, np.random.default_rng(seed))
        likeness.append(np.corrcoef(found.ravel(), picture.ravel())[0, 1])
    assert min(likeness) > 0.8
    assert max(likeness) < 0.9999


def test_leaf_pictures_repeat() -> None:
    one, again = (leaf_picture(np.random.default_rng(2), 64) for _ in range(2))
    assert one.shape == (64, 64)
    np.testing.assert_array_equal(one, again)
