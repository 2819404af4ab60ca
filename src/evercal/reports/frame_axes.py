"""The axes of a frame drawn into an image, as visual evidence for a calibration."""

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import SE3, Camera
from evercal.reports.overlay import overlay_lines

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

LENGTH_M = 0.1
"""Length of the drawn axes."""
_COLOURS = ((214, 39, 40), (44, 160, 44), (31, 95, 220))
"""x red, y green, z blue."""
_PALE = ((237, 158, 158), (160, 212, 160), (154, 183, 239))
_STEPS = 32


def origin_in_view(camera: Camera, camera_from_frame: SE3) -> tuple[Array, str]:
    """Project the origin of a frame: its pixel (2,), and where it lies if outside the image."""
    pixel = camera.project(camera_from_frame.translation_m)
    if camera_from_frame.translation_m[2] <= 0:
        return pixel, "behind the camera"
    inside = (pixel > -0.5) & (pixel < (camera.width - 0.5, camera.height - 0.5))
    return pixel, "" if inside.all() else "outside the image"


def axes_in_view(camera: Camera, camera_from_frame: SE3, length_m: float = LENGTH_M) -> Array:
    """Project the axes of a frame: (3, n, 2) pixels along x, y and z; NaN where not visible."""
    along = np.linspace(0.0, length_m, _STEPS + 1)
    points = np.eye(3)[:, None] * along[:, None]
    return camera.project(camera_from_frame.apply(points))


def draw_axes(
    image: Image, camera: Camera, camera_from_frame: SE3, name: str, pale: bool = False
) -> Image:
    """Draw the axes of a frame into a copy of an image.

    The image may have any size with the aspect ratio of the camera. If the origin is not visible,
    the lower left corner shows the directions of the axes instead, unless they are pale.
    """
    height, width = image.shape[:2]
    camera = camera.resized(width, height)
    pixel, outside = origin_in_view(camera, camera_from_frame)
    lines = axes_in_view(camera, camera_from_frame)
    thickness = max(2, round(width / 220))
    if pale:
        return overlay_lines(image, list(lines), _PALE, thickness)
    if outside:
        length = 0.09 * min(width, height)
        pixel = np.array([1.6 * length, height - 2.0 * length])
        directions = camera_from_frame.rotation_matrix()[:2].T
        lines = pixel + length * np.stack([np.zeros((3, 2)), directions], 1)
        name = f"directions of {name}"
    drawn = overlay_lines(image, list(lines), [(255, 255, 255)] * 3, thickness + 2)
    drawn = overlay_lines(drawn, list(lines), _COLOURS, thickness)
    for letter, line, colour in zip("xyz", lines, _COLOURS, strict=True):
        along = line[-1] - line[0]
        offset = along * 5 * thickness / max(float(np.linalg.norm(along)), 1e-6)
        _write(drawn, letter, line[-1] + offset, colour)
    _write(drawn, name, np.array([4.0, height - 12.0]), (0, 0, 0))
    return drawn


def _write(image: Image, text: str, pixel: Array, colour: tuple[int, int, int]) -> None:
    """Write text with a white rim, a letter centred at the pixel."""
    import cv2

    if not (np.abs(pixel) < 1e5).all():
        return
    size = max(0.45, image.shape[1] / 1000)
    text = text.encode("ascii", "replace").decode()
    (width, height), _ = cv2.getTextSize(text, 0, size, 1)
    left = round(float(pixel[0]) - (width / 2 if len(text) == 1 else 0))
    at = left, round(float(pixel[1]) + height / 2)
    cv2.putText(image, text, at, 0, size, (255, 255, 255), 5, cv2.LINE_AA)
    cv2.putText(image, text, at, 0, size, colour, 1 + (len(text) == 1), cv2.LINE_AA)
