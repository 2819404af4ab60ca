"""The axes of a frame drawn into an image: seen where they should be, they prove a calibration."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evercal.drawing import overlay_lines
from evercal.geometry import SE3, Camera

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

LENGTH_M = 0.1
"""Of the axes that are drawn."""
_COLOURS = ((214, 39, 40), (44, 160, 44), (31, 95, 220))
"""x red, y green, z blue."""
_NEAR_M = 0.005
"""What lies closer to the plane of the lens than this is cut off."""
_STEPS = 32
_BEYOND = 1.3
"""A lens model holds up to this many times the distance of the image's corners from its middle."""


@dataclass(frozen=True, eq=False)
class AxesInView:
    """The three axes of a frame as a camera sees them."""

    lines: tuple[Array, ...]
    """(n, 2) pixels along x, y and z, from the origin on; nan where nothing is seen."""
    origin_px: Array
    """(2,) where the origin is seen, inside the image or not; nan behind the camera."""
    where: str
    """Where the origin lies if it is not in the image, for people; empty if it is."""
    directions: Array
    """(3, 2) right and down, of the unit vectors as the camera sees them, without perspective."""


def axes_in_view(camera: Camera, camera_from_frame: SE3, length_m: float = LENGTH_M) -> AxesInView:
    """Projects the axes of a frame, clipped to what the lens can see.

    Args:
        camera: intrinsics.
        camera_from_frame: single pose.
        length_m: of the axes, metres.
    """
    origin = camera_from_frame.translation_m
    turn = camera_from_frame.rotation_matrix()
    share = np.linspace(0.0, 1.0, _STEPS + 1)
    lines = []
    for axis in turn.T:
        start, end = _in_front(origin, origin + length_m * axis)
        points = start + share[:, None] * (end - start)
        lines.append(_seen(camera, points))
    [pixel] = _seen(camera, origin[None])
    return AxesInView(tuple(lines), pixel, _where(camera, origin, pixel), turn[:2].T)


def draw_axes(
    image: Image, axes: AxesInView, scale: float, name: str = "", older: bool = False
) -> Image:
    """Draws the axes of a frame into an image.

    Args:
        image: (H, W, 3) uint8 RGB.
        axes: in pixels of the camera's image.
        scale: of the image, in pixels for each pixel of the camera's.
        name: of the frame, written at its origin; ASCII.
        older: draws them pale and dashed, to lie beside others.

    Returns:
        A new image of the same size.
    """
    thick = max(2, round(image.shape[1] / 320))
    lines = [(line + 0.5) * scale - 0.5 for line in axes.lines]
    if older:
        pale = [_mixed(colour, 0.6) for colour in _COLOURS]
        return overlay_lines(image, lines, pale, max(1, thick - 1), dash=4.0 * thick)
    drawn = overlay_lines(image, lines, list(_COLOURS), thick)
    for letter, line, colour in zip("xyz", lines, _COLOURS, strict=True):
        if np.isfinite(line[-1]).all():
            _write(drawn, letter, line[-1] + 2 * thick, colour)
    if name and not axes.where:
        _write(drawn, name, (axes.origin_px + 0.5) * scale + (-8 * thick, 8 * thick), (0, 0, 0))
    return drawn


def draw_directions(image: Image, axes: AxesInView, name: str = "") -> Image:
    """Draws in the lower left corner which way the axes point, where they themselves are not seen.

    Args:
        image: (H, W, 3) uint8 RGB.
        axes: of the frame.
        name: of the frame; ASCII.

    Returns:
        A new image of the same size.
    """
    height, width = image.shape[:2]
    reach = 0.09 * min(width, height)
    middle = np.array([1.6 * reach, height - 2.0 * reach])
    ends = middle + reach * axes.directions
    thick = max(2, round(width / 320))
    lines = [np.stack([middle, end]) for end in ends]
    drawn = overlay_lines(image, lines, list(_COLOURS), thick)
    for letter, end, colour in zip("xyz", ends, _COLOURS, strict=True):
        _write(drawn, letter, end + 2 * thick, colour)
    if name:
        _write(drawn, f"directions of {name}", np.array([4.0, height - 6.0]), (0, 0, 0))
    return drawn


def _in_front(start: Array, end: Array) -> tuple[Array, Array]:
    """The part of a segment that lies in front of the camera; the segment itself if none does."""
    ends = [start, end]
    depths = start[2] - _NEAR_M, end[2] - _NEAR_M
    if depths[0] * depths[1] < 0:
        share = depths[0] / (depths[0] - depths[1])
        ends[0 if depths[0] < 0 else 1] = start + share * (end - start)
    return ends[0], ends[1]


def _seen(camera: Camera, points: Array) -> Array:
    """(n, 2) pixels; nan behind the camera and where the lens model no longer holds."""
    # A distortion polynomial folds back far outside the image: it would show what is not there.
    corners = [[x, y] for x in (-0.5, camera.width - 0.5) for y in (-0.5, camera.height - 0.5)]
    limit = _BEYOND * float(np.linalg.norm(camera.unproject(corners)[:, :2], axis=1).max())
    depth = np.where(points[:, 2] >= 0.999 * _NEAR_M, points[:, 2], math.nan)
    slope = np.linalg.norm(points[:, :2], axis=1) / depth
    pixels = np.full((len(points), 2), math.nan)
    ok = slope <= limit
    pixels[ok] = camera.project(points[ok])
    return pixels


def _where(camera: Camera, origin: Array, pixel: Array) -> str:
    """Where an origin lies that is not in the image; empty if it is."""
    if origin[2] < _NEAR_M:
        return f"behind the camera, {max(0.0, -1000 * origin[2]):.0f} mm from the plane of its lens"
    far = not np.isfinite(pixel).all()  # beyond the lens model: a pinhole gives the direction
    pinhole = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    x, y = pinhole.project(origin) if far else pixel
    beyond = {
        "left of": x < -0.5,
        "right of": x > camera.width - 0.5,
        "above": y < -0.5,
        "below": y > camera.height - 0.5,
    }
    sides = [side for side, so in beyond.items() if so]
    if sides:
        return f"outside the image, {' and '.join(sides)} it"
    return "outside the image" if far else ""


def _mixed(colour: tuple[int, int, int], white: float) -> tuple[int, int, int]:
    r, g, b = (round(value + white * (255 - value)) for value in colour)
    return r, g, b


def _write(image: Image, text: str, at: Array, colour: tuple[int, int, int]) -> None:
    """Letters with a white rim."""
    import cv2

    if not (np.isfinite(at).all() and (np.abs(at) < 1e5).all()):
        return
    size = max(0.45, image.shape[1] / 1300)
    words = text.encode("ascii", "replace").decode()
    place = (round(float(at[0])), round(float(at[1])))
    for ink, thickness in (((255, 255, 255), 4), (colour, 1 if len(text) > 1 else 2)):
        cv2.putText(image, words, place, 0, size, ink, thickness, cv2.LINE_AA)
