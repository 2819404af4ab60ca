"""Images as another camera at the same place would see them, drawn from those of a recording.

Rays of the other camera are projected into the recording's image and interpolated there. A view
must lie inside that image, so nothing is padded: a wide lens at full size cannot be drawn. A
shorter focal length in pixels is drawn as fewer pixels of the same view ("size x0.7"). A longer one
magnifies the middle and has no more detail than the recording's pixels.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera

QUARTER_DEG = 90.0


@dataclass(frozen=True)
class View:
    """Another camera with the same centre and optical axis as the recording's."""

    camera: Camera
    """Intrinsics of the view."""
    roll_deg: float = 0.0
    """Turn about the optical axis, clockwise as seen from behind the camera."""

    @property
    def own_from_view(self) -> SE3:
        """Pose of the view in the frame of the recording's camera: base_from_camera @ this."""
        return SE3.exp([0, 0, 0, 0, 0, np.deg2rad(self.roll_deg)])

    def where(self, pixels: np.ndarray, own: Camera) -> np.ndarray:
        """Convert pixels (..., 2) of the view to those of the recording's image (..., 2)."""
        return own.project(self.own_from_view.apply(self.camera.unproject(pixels)))

    def render(self, image: np.ndarray, own: Camera) -> np.ndarray:
        """Draw the view.

        Pixels that are larger than the recording's are means of several rays.

        Args:
            image: Image of the recording, (H, W, 3) uint8.
            own: Its intrinsics.

        Returns:
            Image (h, w, 3) uint8 at the size of the view's camera.

        Raises:
            InputError: The view is wider than the image.
        """
        size = self.camera.width, self.camera.height
        grid = np.stack(np.meshgrid(*map(np.arange, size)), -1)
        across = math.ceil(own.fx / self.camera.fx - 1e-6)
        steps = (np.arange(across) + 0.5) / across - 0.5
        total = np.zeros((*grid.shape[:2], 3))
        for step in product(steps, steps):
            where = self.where(grid + step, own)
            # NaN, beyond the range of a distortion, is outside.
            if not (
                (where >= -0.5) & (where <= (own.width - 0.5, own.height - 0.5))
            ).all():
                raise InputError(
                    f"{self.camera}: wider than the image that it is drawn from"
                )
            x, y = np.moveaxis(where.astype(np.float32), -1, 0)
            total += cv2.remap(
                image.astype(np.float32),
                x,
                y,
                cv2.INTER_CUBIC,
                None,
                cv2.BORDER_REPLICATE,
            )
        return np.clip(np.rint(total / across**2), 0, 255).astype(np.uint8)


def cropped(own: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """Return the camera of a part of the image."""
    return replace(own, width=width, height=height, cx=own.cx - left, cy=own.cy - top)


def rolled(own: Camera, roll_deg: float) -> View:
    """Turn a camera about its optical axis, which is in the middle of the image.

    Quarter turns keep all pixels. Others keep the largest part of the same aspect ratio.
    """
    quarters = roll_deg / QUARTER_DEG
    if quarters == round(quarters):
        sides = (own.width, own.height)
        focal = (own.fx, own.fy)
        order = slice(None, None, -1 if round(quarters) % 2 else 1)
        (width, height), (fx, fy) = sides[order], focal[order]
    else:
        cosine, sine = (abs(f(np.deg2rad(roll_deg))) for f in (np.cos, np.sin))
        across = own.width * cosine + own.height * sine
        down = own.width * sine + own.height * cosine
        divisor = math.gcd(own.width, own.height)
        parts = int(divisor * min(own.width / across, own.height / down))
        width, height = (side * parts // divisor for side in (own.width, own.height))
        fx = own.fx
        fy = own.fy
    return View(
        Camera(width, height, fx, fy, (width - 1) / 2, (height - 1) / 2), roll_deg
    )


def _resized(own: Camera, scale: float) -> View:
    return View(own.resized(round(scale * own.width), round(scale * own.height)))


def _three_quarters(own: Camera, left: float, top: float) -> View:
    """Crop three quarters of both sides; `left` and `top` are shares of the sides."""
    start = round(left * own.width), round(top * own.height)
    return View(cropped(own, *start, 3 * own.width // 4, 3 * own.height // 4))


LENSES: dict[str, Callable[[Camera], View]] = {
    "own camera": View,
    "focal x1.1": lambda own: View(own.zoomed(1.1)),
    "focal x1.25": lambda own: View(own.zoomed(1.25)),
    "focal x1.5": lambda own: View(own.zoomed(1.5)),
    "focal x1.1, k1 -0.15": lambda own: View(
        replace(own.zoomed(1.1), distortion=(-0.15, 0.0, 0.0, 0.0))
    ),
    "half size": lambda own: _resized(own, 0.5),
    "size x0.7": lambda own: _resized(own, 0.7),
    "centre crop": lambda own: _three_quarters(own, 0.125, 0.125),
    "off-centre crop": lambda own: _three_quarters(own, 0.25, 0.0),
}
"""Views from the recording's intrinsics, by name; all without roll."""
ROLLS_DEG = (45, 90, 135, 180, 270)
