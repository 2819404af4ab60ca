"""Depths of the cells of a view: a plane sweep over other posed views of its scene.

Along a cell's ray, the features of other views are most similar where the surface is (Collins, A
space-sweep approach, CVPR 1996).
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from evercal.classes import frozen_arrays
from evercal.features.views import ideal_cell_pixels
from evercal.geometry import SE3, Camera
from evercal.typing import Array, ArrayPair, BoolArray, Float32Array, Size

NEAR_M = 0.25
"""Smallest depth in a room, metres; other recordings scale it (`pose_check.depth_scale`)."""
USUAL_M = 1.5
"""Usual depth in a room, metres, scaled alike."""
FAR_M = 12.0
"""Largest depth in a room, metres, scaled alike."""
PLANES = 96
"""Inverse depths that are tried."""
SEEN_BY = 4
"""A depth is scored by the mean similarity of this many best views; others may be occluded."""
SMOOTHING = 0.7
"""Share of a cell's neighbours in its similarity."""
MIN_PEAK_SIMILARITY = 0.4
"""Peaks of less similarity have no weight in the refinement."""
_MOST_ROWS = 30_000
"""Rows that are sampled at once: cv2.remap takes images of up to 32,767 rows."""
DEPTH_STEP = 1e-4
"""Step of a numerical derivative by the inverse depth, per metre."""
OUTLIER_PX = 4.0
"""Residuals beyond this have little weight in the refinement."""


@frozen_arrays
class PosedCells:
    """The encoded cells of a plain view."""

    features: Array
    """(h * w, channels) unit vectors, row-major over the grid of cells."""
    camera: Camera
    """At working size."""
    base_from_camera: SE3
    """Pose of the view."""
    stride: int
    """Pixels per cell."""

    @property
    def grid(self) -> Size:
        """Rows and columns of cells."""
        return self.camera.height // self.stride, self.camera.width // self.stride

    def rays(self) -> np.ndarray:
        """(h * w, 3) rays through the cell centres in the camera frame, at depth 1.

        NaN where the distortion has no ray for a cell.
        """
        return self.camera.pinhole.unproject(
            ideal_cell_pixels(self.camera, self.stride)
        )


def inverse_depths(
    view: PosedCells,
    others: Sequence[PosedCells],
    guess_m: np.ndarray,
    scale: float = 1.0,
) -> Float32Array:
    """Inverse depth of every cell along the optical axis.

    The plane with the most similar features is refined by two Gauss-Newton steps along the ray,
    towards the sub-cell peaks of similarity in the other views.

    Args:
        view: the view.
        others: see `covisibility.select_source_views`; without other views the guess is returned.
        guess_m: (h * w,) rough depths, metres.
        scale: factor on the depths that are searched, see `NEAR_M`.

    Returns:
        (h * w,) per metre, within 1 / 12 and 1 / 0.25 over the scale.
    """
    least = 1 / (scale * FAR_M)
    most = 1 / (scale * NEAR_M)
    if not others:
        return (1 / guess_m).clip(least, most).astype(np.float32)
    sources = [_SourceView(view, other) for other in others]
    planes = np.linspace(
        least,
        most,
        PLANES,
        dtype=np.float32,
    )
    similarity = np.stack([source.along(planes) for source in sources])
    if len(sources) > SEEN_BY:
        similarity = np.partition(similarity, -SEEN_BY, 0)[-SEEN_BY:]
    score = similarity.mean(0)
    # The mean of a cell's neighbours, without those beyond the border.
    volume = score.reshape(*view.grid, PLANES)
    near = _sums(volume) / _sums(np.ones(view.grid, np.float32))[..., None]
    score = (volume + SMOOTHING * (near - volume)).reshape(-1, PLANES)
    inverse = planes[score.argmax(1)]
    for _ in range(2):
        gradient = np.zeros_like(inverse)
        hessian = np.full_like(inverse, 1e-3)
        for source in sources:
            slope, curvature = source.normal_equation(inverse)
            gradient = gradient + slope
            hessian = hessian + curvature
        step = (gradient / hessian).clip(-0.1 / scale, 0.1 / scale)
        inverse = (inverse + step).clip(least, most).astype(np.float32)
    return inverse


def _sums(values: Array) -> Array:
    """Sums over the 3x3 around each cell of (h, w, ...)."""
    kind = cv2.BORDER_CONSTANT
    return np.asarray(
        cv2.boxFilter(
            values,
            -1,
            (3, 3),
            normalize=False,
            borderType=kind,
        ),
        float,
    )


class _SourceView:
    """Similarity of the cells of a view to all cells of one other view."""

    def __init__(self, view: PosedCells, other: PosedCells):
        self.other = other
        self.rows, self.columns = other.grid
        other_from_view = other.base_from_camera.inverse() @ view.base_from_camera
        self.ray = view.rays() @ other_from_view.rotation_matrix().T
        self.translation = other_from_view.translation_m
        self.similarity = (view.features @ other.features.T).reshape(-1, *other.grid)

    def pixels(self, inverse: Array) -> tuple[Array, Array, BoolArray]:
        """Columns and rows (cells, ...) at inverse depths (cells, ...), and whether visible."""
        ray = self.ray.astype(inverse.dtype).T
        ray = ray.reshape(3, -1, *[1] * (inverse.ndim - 1))
        translation = self.translation.astype(inverse.dtype)
        x = ray[0] + inverse * translation[0]
        y = ray[1] + inverse * translation[1]
        z = ray[2] + inverse * translation[2]
        front = z > 0.05
        z = np.where(front, z, 1)
        camera = self.other.camera
        if camera.distortion:
            pixels = camera.project(np.stack([x, y, z], -1))
            front &= np.isfinite(pixels).all(-1)
            u, v = np.moveaxis(np.nan_to_num(pixels).astype(inverse.dtype), -1, 0)
        else:
            u = camera.fx * x / z + camera.cx
            v = camera.fy * y / z + camera.cy
        return u, v, front

    def along(self, planes: Array) -> Array:
        """(cells, planes) similarity at inverse depths, 0 outside this view."""
        cells = len(self.ray)
        stride = self.other.stride
        u, v, inside = self.pixels(np.broadcast_to(planes, (cells, len(planes))))
        right = (u + 0.5) / stride - 0.5
        down = (v + 0.5) / stride - 0.5
        for at, last in ((right, self.columns - 1), (down, self.rows - 1)):
            inside &= (at > -1) & (at < last + 1)
            np.clip(
                at,
                0,
                last,
                out=at,
            )
        sampled = np.empty((cells, len(planes)), np.float32)
        # The grids of many cells one below the other are one image.
        most = _MOST_ROWS // self.rows
        tops = self.rows * np.arange(most, dtype=np.float32)[:, None]
        for start in range(0, cells, most):
            block = slice(start, start + most)
            image = self.similarity[block].reshape(-1, self.columns)
            below = down[block]
            below = below + tops[: len(below)]
            sampled[block] = cv2.remap(image, right[block], below, cv2.INTER_LINEAR)
        return np.maximum(sampled, 0) * inside

    def normal_equation(self, inverse: Array) -> ArrayPair:
        """Gradient and Hessian (cells,) of least squares in the inverse depth of each cell."""
        rho = inverse.astype(float)
        u, v, front = self.pixels(rho)
        here = np.stack([u, v], 1)
        u, v, _ = self.pixels(rho + DEPTH_STEP)
        slope = (np.stack([u, v], 1) - here) / DEPTH_STEP
        stride = self.other.stride
        centre = (stride - 1) / 2
        cell = np.rint((here - centre) / stride).astype(int)
        last = np.array([self.columns - 2, self.rows - 2])
        inner = cell.clip(1, last)
        inside = front & (cell == inner).all(1)
        position, similarity = peak(self.similarity, inner[:, 1], inner[:, 0])
        residual = stride * position + centre - here
        weight = inside * np.maximum(similarity - MIN_PEAK_SIMILARITY, 0) ** 2
        weight = weight / (1 + (residual**2).sum(1) / OUTLIER_PX**2)
        gradient = weight * (slope * residual).sum(1)
        hessian = weight * (slope * slope).sum(1)
        return gradient, hessian


def peak(
    similarity: Array,
    row: NDArray[np.integer],
    column: NDArray[np.integer],
) -> ArrayPair:
    """The most similar cell of the 3x3 around a cell, to a fraction of a cell.

    The similarity (n, h, w) is that of n cells to all cells of another view; rows and columns (n,)
    lie inside its border. Returns (n, 2) column and row, and the similarity (n,) of the nearest
    cell.
    """
    _, height, width = similarity.shape
    n = np.arange(len(similarity))
    down, right = np.indices((3, 3)).reshape(2, 9) - 1
    patch = similarity[n[:, None], row[:, None] + down, column[:, None] + right]
    best = patch.argmax(1)
    row = (row + down[best]).clip(1, height - 2)
    column = (column + right[best]).clip(1, width - 2)
    middle = similarity[n, row, column]
    left = similarity[n, row, column - 1]
    right = similarity[n, row, column + 1]
    above = similarity[n, row - 1, column]
    below = similarity[n, row + 1, column]
    u = column + parabola(left, middle, right)
    v = row + parabola(above, middle, below)
    return np.stack([u, v], 1), middle


def parabola(
    before: Array,
    middle: Array,
    after: Array,
) -> Array:
    """Maximum of a parabola through three values, relative to the middle; at most half a step."""
    curvature = np.minimum(before - 2 * middle + after, -1e-3)
    return (0.5 * (before - after) / curvature).clip(-0.5, 0.5)
