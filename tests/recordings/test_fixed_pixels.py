"""What shows the same in all images of a moving camera."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.recordings.fixed_pixels import fixed_pixels, without_fixed_pixels
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.masks import PartOfImage
from evercal.typing import BoolArray, Image

WIDTH, HEIGHT = 320, 240
CAMERA = Camera(WIDTH, HEIGHT, 260.0, 260.0, 159.5, 119.5)
Overlay = Callable[[int, Image], Image]


def textured(seed: int, side: int) -> Image:
    """(side, side) blobs of all sizes."""
    rng = np.random.default_rng(seed)
    image = np.zeros((side, side))
    for cells in (8, 16, 32, 64, 128):
        coarse = rng.normal(size=(cells, cells))
        image += cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 28 * image, 0, 255).astype(np.uint8)


WORLD = textured(0, 900)


def view(number: int, step: float = 23.0, turn_deg: float = 4.0) -> Image:
    """(h, w, 3) of a camera that moves over the world and turns."""
    rng = np.random.default_rng(number)
    angle = turn_deg * number
    centre = (300 + step * number % 300, 300 + (1.7 * step * number) % 300)
    matrix = cv2.getRotationMatrix2D(centre, angle, 1 + 0.02 * (number % 5))
    matrix[:, 2] += (WIDTH / 2 - centre[0], HEIGHT / 2 - centre[1])
    image = cv2.warpAffine(WORLD, matrix, (WIDTH, HEIGHT), borderMode=cv2.BORDER_WRAP)
    noisy = image + rng.normal(0, 3, image.shape)
    return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, 2)


def written(text: str, at: tuple[int, int], bar: int | None) -> Overlay:
    """Text that the camera burns in, on a bar of one grey value or on the image."""

    def draw(number: int, image: Image) -> Image:
        y = at[1]
        if bar is not None:
            image[max(y - 16, 0) : y + 6] = bar
        colour = (255 - (bar or 0),) * 3
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(image, text.format(number), at, font, 0.45, colour, 1)
        return image

    return draw


def gripper(outline: list[tuple[int, int]], flicker: float = 0.0) -> Overlay:
    """A part of the gripper; `flicker` is the relative change of its brightness."""
    mask = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
    cv2.fillPoly(mask, [np.array(outline)], 1)
    surface = textured(5, 400)[:HEIGHT, :WIDTH, None]

    def draw(number: int, image: Image) -> Image:
        bright = surface * (1 + flicker * np.sin(number))
        return np.where(mask, np.clip(bright, 0, 255), image).astype(np.uint8)

    return draw


def lens_edge(radius: float) -> Overlay:
    """Black corners outside the circle that a wide lens covers."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    outside = np.hypot(x - WIDTH / 2, y - HEIGHT / 2) > radius

    def draw(_: int, image: Image) -> Image:
        return np.where(outside[..., None], 0, image).astype(np.uint8)

    return draw


OVERLAYS = {
    "name and time on a bar": written("CAM 3 10:{:02d}", (8, 16), 0),
    "white bar below": written("LINE 4 WEST", (8, 234), 255),
    "text without a bar": written("GANTRY 07", (180, 230), None),
    "text in the middle": written("NO SIGNAL 2", (90, 120), None),
    "serial number": written("SN 0451-77-A", (200, 16), None),
    "grey bar": written("frame of 09", (100, 234), 90),
    "left finger": gripper([(40, 240), (110, 240), (100, 130)]),
    "right finger": gripper([(280, 240), (210, 240), (220, 130)]),
    "two fingers": gripper([(60, 240), (130, 150), (160, 240), (190, 150), (260, 240)]),
    "palm": gripper([(0, 240), (320, 240), (250, 180), (70, 180)]),
    "suction cup": gripper([(130, 0), (190, 0), (175, 70), (145, 70)]),
    "cable": gripper([(0, 60), (6, 60), (120, 240), (100, 240)]),
    "finger in changing light": gripper([(40, 240), (120, 240), (110, 120)], 0.4),
    "mount at the left edge": gripper([(0, 0), (45, 0), (30, 240), (0, 240)]),
    "mount at the top": gripper([(0, 0), (320, 0), (320, 30), (0, 40)]),
    "edge of a wide lens": lens_edge(165),
    "edge of a fisheye": lens_edge(125),
    "logo": gripper([(280, 8), (312, 8), (312, 40), (280, 40)]),
    "half of the gripper": gripper([(0, 240), (0, 150), (150, 190), (150, 240)]),
    "crosshair": gripper([(150, 118), (170, 118), (170, 122), (150, 122)]),
}
"""Overlays that are the same in all images."""


def greys(overlay: Overlay | None, count: int = 12) -> list[Image]:
    """(h, w) of views with an overlay."""
    images = []
    for number in range(count):
        image = view(number)
        if overlay:
            image = overlay(number, image.copy())
        images.append(image[..., 0])
    return images


def opaque(overlay: Overlay) -> tuple[BoolArray, BoolArray]:
    """(h, w) pixels that an overlay covers, and those of them with an edge within it."""
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    on_black = overlay(0, black.copy())[..., 0]
    on_white = overlay(0, black + 255)[..., 0]
    covered = (on_black == on_white).astype(np.uint8)
    inside = cv2.erode(covered, np.ones((3, 3), np.uint8)) > 0
    slope = cv2.morphologyEx(on_black, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    return covered > 0, inside & (slope > 30)


@pytest.mark.parametrize("name", OVERLAYS)
def test_an_overlay_is_left_out(name: str) -> None:
    fixed = fixed_pixels(greys(OVERLAYS[name]))
    if name == "crosshair":  # less than a letter: SIFT has no feature there
        return
    covered, edges = opaque(OVERLAYS[name])
    if edges.any():
        assert fixed[edges].mean() > 0.8
    assert fixed.any()
    around = cv2.dilate(covered.astype(np.uint8), np.ones((31, 31), np.uint8)) > 0
    assert fixed[~around].mean() < 0.01


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_without_an_overlay_keeps_everything(seed: int) -> None:
    images = [view(100 * seed + i, step=7 + 9 * seed)[..., 0] for i in range(12)]
    assert not fixed_pixels(images).any()


def test_a_camera_that_stands_still_keeps_everything() -> None:
    rng = np.random.default_rng(0)
    still = view(3)[..., 0].astype(float)
    images = [np.clip(still + rng.normal(0, 3, still.shape), 0, 255) for _ in range(12)]
    assert not fixed_pixels([image.astype(np.uint8) for image in images]).any()


def test_views_from_four_places_are_no_overlay() -> None:
    """Every fourth image repeats the first one."""
    images = [view(3 + i % 4, step=90)[..., 0] for i in range(12)]
    assert fixed_pixels(images).mean() < 0.1


def test_few_images_are_not_compared() -> None:
    assert not fixed_pixels(greys(OVERLAYS["palm"], 4)).any()
    assert not fixed_pixels(greys(OVERLAYS["palm"], 1)).any()


def test_training_images_lack_it_and_test_images_keep_it() -> None:
    overlay = OVERLAYS["palm"]
    frames = []
    for number in range(8):
        image = overlay(number, view(number))
        frames.append(Frame(str(number), image, CAMERA, SE3.identity()))
    recording = Recording("r", tuple(frames[:7]), tuple(frames[7:]))
    shown, share = without_fixed_pixels(recording)
    assert 0.1 < share < 0.3
    assert all(isinstance(frame.image, PartOfImage) for frame in shown.train)
    assert np.ptp(shown.train[0].read_image()[225:235, 100:220].astype(int)) < 40
    assert shown.test == recording.test
