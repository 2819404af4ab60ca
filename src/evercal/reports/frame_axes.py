"""The axes of a frame drawn into an image, as visual evidence for a calibration."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evercal.geometry import SE3, Camera
from evercal.reports.overlay import overlay_lines

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

LENGTH_M = 0.1
"""Length of the drawn axes."""
_COLOURS = ((214, 39, 40), (44, 160, 44), (31, 95, 220))
"""x red, y green, z blue."""
_PALE = ((237, 158, 158), (160, 212, 160), (154, 183, 239))
_NEAR_M = 0.005
"""Depth below which axes are cut off."""
_STEPS = 32
_BEYOND = 1.3
"""Range of validity of a distortion model, as a multiple of the distance to the image corners."""


@dataclass(frozen=True, eq=False)
class AxesInView:
    """The projected axes of a frame."""

    lines: tuple[Array, ...]
    """(n, 2) pixels along x, y and z, starting at the origin; NaN where not visible."""
    origin_px: Array
    """(2,) projected origin, inside the image or not; NaN behind the camera."""
    outside: str
    """Position of an origin outside the image, in words; empty inside."""
    directions: Array
    """(3, 2) orthographic projections of the unit vectors, right and down."""

    def scaled(self, scale: float, offset: ArrayLike | None = None) -> "AxesInView":
        """The same axes in a resized or cropped copy of the image.

        `offset` (2,) is the position of the original's pixel (0, 0) in the copy; None for a resized
        copy of the whole image.
        """
        # Resizing scales about the image corner at -0.5.
        shift = np.full(2, 0.5 * scale - 0.5) if offset is None else np.asarray(offset, np.float64)
        lines = tuple(scale * line + shift for line in self.lines)
        return replace(self, lines=lines, origin_px=scale * self.origin_px + shift)


def axes_in_view(camera: Camera, camera_from_frame: SE3, length_m: float = LENGTH_M) -> AxesInView:
    """Project the axes of a frame."""
    origin = camera_from_frame.translation_m
    rotation = camera_from_frame.rotation_matrix()
    share = np.linspace(0.0, 1.0, _STEPS + 1)
    lines = []
    for axis in rotation.T:
        start, end = _clip_depth(origin, origin + length_m * axis)
        lines.append(_project(camera, start + share[:, None] * (end - start)))
    [pixel] = _project(camera, origin[None])
    return AxesInView(tuple(lines), pixel, _outside(camera, origin, pixel), rotation[:2].T)


def draw_axes(image: Image, axes: AxesInView, name: str = "", older: bool = False) -> Image:
    """Draw the axes of a frame into a copy of an image.

    They are given in pixels of this image (`AxesInView.scaled`). The name is written at the origin.
    Older axes are pale and dashed.
    """
    width = max(2, round(image.shape[1] / 220))
    if older:
        return overlay_lines(image, axes.lines, _PALE, width, dash=4.0 * width)
    drawn = _lines_with_letters(image, axes.lines, width)
    if name and not axes.outside:
        ends = np.array([line[-1] for line in axes.lines])
        offset = _away(axes.origin_px - np.nanmean(ends, axis=0), 14 * width)
        _write(drawn, name, axes.origin_px + offset, (0, 0, 0))
    return drawn


def close_up(
    image: Image, camera: Camera, axes: AxesInView, older: AxesInView | None, width: int
) -> Image | None:
    """Enlarge the part of an image around the origin of a frame and draw its axes.

    The camera is of any size with the aspect ratio of the image. Returns (width, width, 3); None if
    the origin is outside the image or the axes are large anyway.
    """
    import cv2

    if axes.outside:
        return None
    ends = np.array([line[-1] for line in axes.lines]) - axes.origin_px
    half = 1.5 * float(np.nanmax(np.linalg.norm(ends, axis=1), initial=0.0))
    if not 4.0 < half < 0.2 * camera.width:
        return None
    scale = width / (2 * half)
    offset = (width - 1) / 2 - scale * axes.origin_px
    own = camera.width / image.shape[1]  # camera pixels per image pixel
    corner = offset + scale * (0.5 * own - 0.5)
    matrix = np.array([[scale * own, 0.0, corner[0]], [0.0, scale * own, corner[1]]])
    part = cv2.warpAffine(image, matrix, (width, width), flags=cv2.INTER_CUBIC)
    drawn = draw_axes(np.asarray(part, dtype=np.uint8), axes.scaled(scale, offset))
    return drawn if older is None else draw_axes(drawn, older.scaled(scale, offset), older=True)


def draw_directions(image: Image, axes: AxesInView, name: str = "") -> Image:
    """Draw the directions of the axes in the lower left corner of a copy of an image."""
    height, width = image.shape[:2]
    length = 0.09 * min(width, height)
    origin = np.array([1.6 * length, height - 2.0 * length])
    lines = [np.stack([origin, origin + length * direction]) for direction in axes.directions]
    drawn = _lines_with_letters(image, lines, max(2, round(width / 220)))
    if name:
        text = f"directions of {name}"
        _write(drawn, text, np.array([4.0, height - 12.0]), (0, 0, 0), centred=False)
    return drawn


def _lines_with_letters(image: Image, lines: Sequence[Array], width: int) -> Image:
    drawn = overlay_lines(image, lines, _COLOURS, width)
    for letter, line, colour in zip("xyz", lines, _COLOURS, strict=True):
        _write(drawn, letter, line[-1] + _away(line[-1] - line[0], 5 * width), colour)
    return drawn


def _clip_depth(start: Array, end: Array) -> tuple[Array, Array]:
    """Clip a segment to the part in front of the camera. A segment behind it is unchanged."""
    ends = [start, end]
    depths = start[2] - _NEAR_M, end[2] - _NEAR_M
    if depths[0] * depths[1] < 0:
        share = depths[0] / (depths[0] - depths[1])
        ends[0 if depths[0] < 0 else 1] = start + share * (end - start)
    return ends[0], ends[1]


def _project(camera: Camera, points: Array) -> Array:
    """(n, 2) pixels; NaN behind the camera and outside the range of the distortion model."""
    # Far outside the image, a distortion polynomial can fold points back into it.
    corners = [[x, y] for x in (-0.5, camera.width - 0.5) for y in (-0.5, camera.height - 0.5)]
    corner = np.linalg.norm(camera.unproject(corners)[:, :2], axis=1)
    limit = _BEYOND * float(np.nan_to_num(corner, nan=camera.widest).max())
    depth = np.where(points[:, 2] >= 0.999 * _NEAR_M, points[:, 2], math.nan)
    valid = np.linalg.norm(points[:, :2], axis=1) / depth <= limit
    pixels = np.full((len(points), 2), math.nan)
    pixels[valid] = camera.project(points[valid])
    return pixels


def _outside(camera: Camera, origin: Array, pixel: Array) -> str:
    """Position of an origin outside the image, in words; empty inside."""
    if origin[2] < _NEAR_M:
        return f"behind the camera, {max(0.0, -1000 * origin[2]):.0f} mm from its principal plane"
    undefined = not np.isfinite(pixel).all()  # outside the distortion model: assume a pinhole
    pinhole = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    x, y = pinhole.project(origin) if undefined else pixel
    tests = {
        "left of": x < -0.5,
        "right of": x > camera.width - 0.5,
        "above": y < -0.5,
        "below": y > camera.height - 0.5,
    }
    sides = [side for side, beyond in tests.items() if beyond]
    if sides:
        return f"outside the image, {' and '.join(sides)} it"
    return "outside the image" if undefined else ""


def _away(direction: Array, distance: float) -> Array:
    """(2,) vector of a length along a direction; zero for a zero direction."""
    length = float(np.linalg.norm(direction))
    return direction * (distance / length) if length > 1e-6 else np.zeros(2)


def _write(
    image: Image, text: str, pixel: Array, colour: tuple[int, int, int], centred: bool = True
) -> None:
    """Write a letter with a white rim, or a name on a white box."""
    import cv2

    if not (np.isfinite(pixel).all() and (np.abs(pixel) < 1e5).all()):
        return
    size = max(0.45, image.shape[1] / 1000)
    text = text.encode("ascii", "replace").decode()
    (width, height), below = cv2.getTextSize(text, 0, size, 1)
    left = round(float(pixel[0]) - (width / 2 if centred else 0))
    line = round(float(pixel[1]) + height / 2)
    white = (255, 255, 255)
    if len(text) == 1:
        cv2.putText(image, text, (left, line), 0, size, white, 5, cv2.LINE_AA)
        cv2.putText(image, text, (left, line), 0, size, colour, 2, cv2.LINE_AA)
        return
    corners = (left - 3, line - height - 3), (left + width + 3, line + below)
    cv2.rectangle(image, *corners, white, -1)
    cv2.putText(image, text, (left, line), 0, size, colour, 1, cv2.LINE_AA)
