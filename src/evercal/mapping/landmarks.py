"""Landmarks: textured pixels of a keyframe with depth, slant and uncertainty."""

from typing import NamedTuple

import cv2
import numpy as np

from evercal.classes import frozen_arrays
from evercal.geometry import Camera, spread
from evercal.typing import Array, Image, IntArray, Size

MIN_TEXTURE = 1e-4
"""Smallest minimum eigenvalue (cv2.cornerMinEigenVal, 5x5) of a landmark's pixel."""
BORDER_PX = 6
"""Landmarks and their projections lie at least this far inside the image."""
NEAREST_M = 1e-3
"""Smallest depth of a visible landmark, metres."""
_TANGENT_PX = 2.0
"""Distance of the points that span the surface of a landmark, pixels."""
_MIN_AREA = 0.2
"""Smallest area of a warped patch, relative to its keyframe."""
_MAX_AREA = 5.0
"""Largest area of a warped patch."""


@frozen_arrays
class Landmarks:
    """The landmarks of one keyframe."""

    pixels: Array
    """(n, 2) whole pixels of the keyframe's image."""
    inverse_depth: Array
    """(n,) per metre along the optical axis."""
    slope: Array
    """(n, 2) change of the inverse depth per pixel: the slant of the surface."""
    sigma: Array
    """(n,) standard deviation of the inverse depth, per metre."""

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, index: IntArray) -> "Landmarks":
        """The landmarks of an index."""
        return Landmarks(
            self.pixels[index],
            self.inverse_depth[index],
            self.slope[index],
            self.sigma[index],
        )

    def surface(self, camera: Camera) -> Array:
        """(3, n, 3) points in the keyframe's camera frame, metres.

        The landmarks, and the points of their surfaces two pixels to the right and two pixels down.
        """
        steps = np.array([[0, 0], [_TANGENT_PX, 0], [0, _TANGENT_PX]])
        pixels = self.pixels[None] + steps[:, None]
        inverse = self.inverse_depth + (steps @ self.slope.T)
        return camera.unproject(pixels) / inverse[..., None]


class ProjectedPatches(NamedTuple):
    """The m visible patches of n landmarks, as a camera should show them."""

    landmark: IntArray
    """(m,)."""
    pixels: Array
    """(m, 2)."""
    affines: Array
    """(m, 2, 2) from keyframe pixels to this image."""


def project_surface(
    points: Array,
    rotation: Array,
    translation_m: Array,
    camera: Camera,
    most: int | None = None,
) -> ProjectedPatches:
    """Predict positions and warps of patches in an image.

    A patch is visible if it lies in front of the camera, inside the image by a margin, and its size
    is similar to that in its keyframe. At most `most` are taken, evenly spread. Points (3, n, 3)
    are those of `Landmarks.surface`, in any frame; rotation and translation lead from there to the
    camera.
    """
    centre = rotation @ points[0].T + translation_m[:, None]
    u, v = camera.project(centre.T).T
    inside = centre[2] > NEAREST_M
    inside &= (u > BORDER_PX) & (u < camera.width - BORDER_PX - 1)
    inside &= (v > BORDER_PX) & (v < camera.height - BORDER_PX - 1)
    visible = np.flatnonzero(inside)
    pixels = np.stack([u[visible], v[visible]], 1)
    columns = points[1:, visible].transpose(0, 2, 1)
    beside = rotation @ columns + translation_m[:, None]
    depth = beside[:, 2]
    np.maximum(depth, NEAREST_M, out=depth)
    tangents = camera.project(beside.transpose(0, 2, 1)) - pixels
    affines = tangents.transpose(1, 2, 0) / _TANGENT_PX
    (a, b), (c, d) = affines.transpose(1, 2, 0)
    area = a * d - b * c
    similar = np.flatnonzero((area > _MIN_AREA) & (area < _MAX_AREA))
    if most is not None:
        similar = similar[spread(len(similar), most)]
    return ProjectedPatches(visible[similar], pixels[similar], affines[similar])


def detect(
    grey: Image,
    grid: Size,
    cell_px: float,
) -> tuple[Array, IntArray]:
    """Detect the most textured pixel of every textured cell.

    The image (h, w) is uint8, and a cell has `cell_px` pixels. Returns pixels (n, 2) and their
    cells (n,), row-major.
    """
    texture = cv2.cornerMinEigenVal(grey, 5)
    inner = np.zeros_like(texture)
    middle = slice(BORDER_PX, -BORDER_PX)
    inner[middle, middle] = texture[middle, middle]
    edges = np.rint(np.arange(max(grid) + 1) * cell_px).astype(int).tolist()
    pixels = []
    cells = []
    for cell in range(grid[0] * grid[1]):
        row, column = divmod(cell, grid[1])
        top = edges[row]
        left = edges[column]
        block = inner[top : edges[row + 1], left : edges[column + 1]]
        v, u = divmod(int(block.argmax()), block.shape[1])
        if block[v, u] > MIN_TEXTURE:
            pixels.append((left + u, top + v))
            cells.append(cell)
    return np.array(pixels, float).reshape(-1, 2), np.array(cells, np.int64)


def slopes(
    inverse_depth: Array,
    grid: Size,
    cell_px: float,
) -> Array:
    """(cells, 2) change of inverse depth per pixel, from the inverse depths (cells,) of a grid.

    The inverse depth of a plane is linear in the image, so its gradient is the plane's slant.
    """
    field = cv2.medianBlur(inverse_depth.reshape(grid).astype(np.float32), 3)
    field = cv2.GaussianBlur(field, (0, 0), 1.0)
    right = cv2.Sobel(
        field,
        cv2.CV_32F,
        1,
        0,
        ksize=3,
        scale=1 / 8,
    )
    down = cv2.Sobel(
        field,
        cv2.CV_32F,
        0,
        1,
        ksize=3,
        scale=1 / 8,
    )
    pixels = np.stack([right, down], -1).reshape(-1, 2)
    return pixels.astype(float) / cell_px
