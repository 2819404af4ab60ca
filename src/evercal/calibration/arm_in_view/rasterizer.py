"""`Rasterizer`: which link of an arm each pixel of a pinhole camera shows."""

from collections.abc import Sequence

import cv2
import numpy as np

from evercal.geometry import Camera
from evercal.robot.link_shapes import LinkShape
from evercal.typing import Array, IntArray

_NEAR_M = 0.05
"""Nearer surfaces are not drawn."""
_FAR_M = 50.0
"""Distance of pixels without a surface."""
_SHADES = 256
"""Links are drawn as shades of grey, which hold this many numbers."""


class Rasterizer:
    """Draws the links of an arm with OpenCV's rasterizer."""

    def __init__(self, shapes: Sequence[LinkShape]) -> None:
        faces = []
        shades = []
        first = 0
        for number, shape in enumerate(shapes):
            faces.append(shape.faces + first)
            shade = np.full((len(shape.vertices), 3), (number + 1) / _SHADES)
            shades.append(shade)
            first += len(shape.vertices)
        self._vertices = [shape.vertices for shape in shapes]
        self._faces = np.concatenate(faces).astype(np.int32)
        self._shades = np.concatenate(shades).astype(np.float32)
        settings = cv2.TriangleRasterizeSettings()
        settings = settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)
        self._settings = settings.setShadingType(cv2.RASTERIZE_SHADING_FLAT)

    def draw(self, camera_from_link: Array, camera: Camera) -> IntArray:
        """Draw links at poses (links, 4, 4): (h, w) number of the link, -1 where there is none.

        OpenCV's rasterizer has its principal point in the middle of the image and one focal
        length. So a larger image is drawn of points that are sheared, and cropped.
        """
        points = []
        for vertices, pose in zip(self._vertices, camera_from_link, strict=True):
            points.append(vertices @ pose[:3, :3].T + pose[:3, 3])
        x, y, z = np.concatenate(points).T
        half_width = _half(camera.cx, camera.width)
        half_height = _half(camera.cy, camera.height)
        left = int(np.floor(camera.cx))
        top = int(np.floor(camera.cy))
        shear_x = (camera.cx - left + 0.5) / camera.fy
        shear_y = (camera.cy - top + 0.5) / camera.fy
        # Its axes are those of OpenGL: y up, z backward.
        drawn = [x * camera.fx / camera.fy + z * shear_x, -y - z * shear_y, -z]
        size = 2 * half_height, 2 * half_width
        shade = np.zeros((*size, 3), np.float32)
        depth = np.full(size, _FAR_M, np.float32)
        field_of_view = 2 * np.arctan(half_height / camera.fy)
        cv2.triangleRasterize(
            np.stack(drawn, 1).astype(np.float32),
            self._faces,
            self._shades,
            shade,
            depth,
            np.eye(4),
            field_of_view,
            _NEAR_M,
            _FAR_M,
            self._settings,
        )
        rows = slice(half_height - top, half_height - top + camera.height)
        columns = slice(half_width - left, half_width - left + camera.width)
        numbers = np.rint(shade[rows, columns, 0] * _SHADES).astype(np.int64)
        return numbers - 1


def _half(centre: float, size: int) -> int:
    """Half of the side of an image around the principal point that holds the whole image."""
    return int(np.ceil(max(centre, size - 1 - centre))) + 1
