"""The axes of a frame drawn into an image: seen where they should be, they prove a calibration."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evercal.geometry import SE3, Camera
from evercal.reports import overlay_lines

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

    def placed(self, scale: float, shift: ArrayLike | None = None) -> "AxesInView":
        """The same axes in an image that is a resized or cut-out copy of the camera's.

        Args:
            scale: pixels of the copy for each pixel of the camera's image.
            shift: (2,) pixels of the copy at which pixel (0, 0) lies; None for the whole image.
        """
        # Resizing scales about the image's corner, which lies at -0.5.
        by = np.full(2, 0.5 * scale - 0.5) if shift is None else np.asarray(shift, np.float64)
        lines = tuple(scale * line + by for line in self.lines)
        return replace(self, lines=lines, origin_px=scale * self.origin_px + by)


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


def draw_axes(image: Image, axes: AxesInView, name: str = "", older: bool = False) -> Image:
    """Draws the axes of a frame into an image.

    Args:
        image: (H, W, 3) uint8 RGB.
        axes: in pixels of this image (`AxesInView.placed`).
        name: of the frame, written at its origin; ASCII.
        older: draws them pale and dashed, to lie beside others.

    Returns:
        A new image of the same size.
    """
    thick = max(2, round(image.shape[1] / 220))
    if older:
        pale = [_mixed(colour, 0.55) for colour in _COLOURS]
        return overlay_lines(image, axes.lines, pale, thick, dash=4.0 * thick)
    drawn = overlay_lines(image, axes.lines, list(_COLOURS), thick)
    for letter, line, colour in zip("xyz", axes.lines, _COLOURS, strict=True):
        if np.isfinite(line[-1]).all():
            _write(drawn, letter, line[-1] + _away(line[-1] - line[0], 5 * thick), colour)
    if name and not axes.where:
        ends = np.array([line[-1] for line in axes.lines])
        away = _away(axes.origin_px - np.nanmean(ends, axis=0), 14 * thick)
        _write(drawn, name, axes.origin_px + away, (0, 0, 0))
    return drawn


def close_up(
    image: Image, camera: Camera, axes: AxesInView, older: AxesInView | None, width: int
) -> Image | None:
    """The part of an image around the origin of a frame, enlarged, with its axes.

    Args:
        image: (H, W, 3) uint8 RGB.
        camera: whose pixels the axes are in, of any size of the same proportions.
        axes: to draw.
        older: to draw pale and dashed beside them; may be None.
        width: of the part and its height, pixels.

    Returns:
        (width, width, 3); None where the origin is not in the image, or the axes fill much of it.
    """
    import cv2

    if axes.where:
        return None
    ends = np.array([line[-1] for line in axes.lines]) - axes.origin_px
    half = 1.5 * float(np.nanmax(np.linalg.norm(ends, axis=1), initial=0.0))
    if not 4.0 < half < 0.2 * camera.width:
        return None
    scale = width / (2 * half)
    shift = (width - 1) / 2 - scale * axes.origin_px
    own = camera.width / image.shape[1]  # of the camera's pixels for each of the image's
    enlarge = scale * own
    corner = shift + scale * (0.5 * own - 0.5)
    matrix = np.array([[enlarge, 0.0, corner[0]], [0.0, enlarge, corner[1]]])
    part = cv2.warpAffine(image, matrix, (width, width), flags=cv2.INTER_CUBIC)
    part = np.asarray(part, dtype=np.uint8)
    drawn = draw_axes(part, axes.placed(scale, shift))
    return drawn if older is None else draw_axes(drawn, older.placed(scale, shift), older=True)


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
    thick = max(2, round(width / 220))
    lines = [np.stack([middle, end]) for end in ends]
    drawn = overlay_lines(image, lines, list(_COLOURS), thick)
    for letter, end, colour in zip("xyz", ends, _COLOURS, strict=True):
        _write(drawn, letter, end + _away(end - middle, 5 * thick), colour)
    if name:
        words = f"directions of {name}"
        _write(drawn, words, np.array([4.0, height - 12.0]), (0, 0, 0), middle=False)
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
    corner = np.linalg.norm(camera.unproject(corners)[:, :2], axis=1)
    limit = _BEYOND * float(np.nan_to_num(corner, nan=camera.widest).max())
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


def _away(direction: Array, distance: float) -> Array:
    """(2,) so far along a direction; none where there is none."""
    length = float(np.linalg.norm(direction))
    return direction * (distance / length) if length > 1e-6 else np.zeros(2)


def _write(
    image: Image, text: str, at: Array, colour: tuple[int, int, int], middle: bool = True
) -> None:
    """A letter with a white rim, or a name on white, its middle or its left end at a pixel."""
    import cv2

    if not (np.isfinite(at).all() and (np.abs(at) < 1e5).all()):
        return
    size = max(0.45, image.shape[1] / 1000)
    words = text.encode("ascii", "replace").decode()
    (wide, high), below = cv2.getTextSize(words, 0, size, 1)
    left, line = round(float(at[0]) - (wide / 2 if middle else 0)), round(float(at[1]) + high / 2)
    white = (255, 255, 255)
    if len(words) == 1:
        cv2.putText(image, words, (left, line), 0, size, white, 5, cv2.LINE_AA)
        cv2.putText(image, words, (left, line), 0, size, colour, 2, cv2.LINE_AA)
        return
    cv2.rectangle(image, (left - 3, line - high - 3), (left + wide + 3, line + below), white, -1)
    cv2.putText(image, words, (left, line), 0, size, colour, 1, cv2.LINE_AA)
