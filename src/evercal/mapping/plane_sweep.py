"""Depths of the cells of a view: a plane sweep over other posed views of its scene.

Along a cell's ray, the features of other views are most similar where the surface is (Collins, A
space-sweep approach, CVPR 1996).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from evercal.features.views import ideal_cell_pixels
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3

NEAR_M, USUAL_M, FAR_M = 0.25, 1.5, 12.0
"""Depths in a room; other recordings scale them (`pose_check.depth_scale`)."""
PLANES = 96
"""Inverse depths that are tried."""
SEEN_BY = 4
"""A depth is scored by the mean similarity of this many best views; others may be occluded."""
SMOOTHING = 0.7
"""Share of a cell's neighbours in its similarity."""
PARALLAX_RAD = np.deg2rad([4.0, 20.0, 35.0])
"""Parallax of a good view: at least the first, at most the second, useless from the third on."""
MIN_USEFULNESS = 0.1
"""Smallest mean usefulness of a source view."""
PROBED_CELLS = 64
"""Cells of a view that are projected into other views."""
MIN_PEAK_SIMILARITY = 0.4
OUTLIER_PX = 4.0
"""Residuals beyond this have little weight in the refinement."""


@dataclass(frozen=True, eq=False)
class PosedCells:
    """The encoded cells of a plain view."""

    features: Tensor
    """(h * w, channels) unit vectors, row-major over the grid of cells."""
    camera: Camera
    """At working size."""
    base_from_camera: SE3
    """Pose of the view."""
    stride: int
    """Pixels per cell."""

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        return self.camera.height // self.stride, self.camera.width // self.stride

    def rays(self) -> np.ndarray:
        """(h * w, 3) rays through the cell centres in the camera frame, at depth 1.

        NaN where the distortion has no ray for a cell.
        """
        return self.camera.pinhole.unproject(ideal_cell_pixels(self.camera, self.stride))


def select_source_views(
    depth_m: np.ndarray, view: PosedCells, poses: SE3, cameras: Sequence[Camera], count: int
) -> list[int]:
    """Select the views that show the surfaces of a view under good parallax.

    Rough depths (h * w,) are those of the cells of the view; poses (n,) are base_from_camera.
    """
    some = np.linspace(0, len(depth_m) - 1, PROBED_CELLS).astype(int)
    points = view.base_from_camera.apply(view.rays()[some] * depth_m[some, None])
    own = points - view.base_from_camera.translation_m
    own /= np.linalg.norm(own, axis=-1, keepdims=True)
    few, enough, many = PARALLAX_RAD
    other = points - poses.translation_m[:, None]
    within = other @ poses.rotation_matrix()
    front = within[..., 2:] > 0
    within = np.where(front, within, [0, 0, 1])
    visible = front[..., 0]
    for camera in set(cameras):
        rows = [i for i, own_camera in enumerate(cameras) if own_camera == camera]
        pixels = camera.project(within[rows])
        visible[rows] &= ((pixels > 0) & (pixels < [camera.width, camera.height])).all(-1)
    other /= np.linalg.norm(other, axis=-1, keepdims=True) + 1e-9
    parallax = np.arccos(np.clip((own * other).sum(-1), -1, 1))
    useful = np.clip(parallax / few, 0, 1) * np.clip((many - parallax) / (many - enough), 0, 1)
    usefulness = np.where(visible, useful, 0).mean(-1)
    best = np.argsort(-usefulness, kind="stable")[:count]
    return [int(i) for i in best if usefulness[i] > MIN_USEFULNESS]


def inverse_depths(
    view: PosedCells,
    others: Sequence[PosedCells],
    guess_m: np.ndarray,
    scale: float = 1.0,
) -> Tensor:
    """Inverse depth of every cell along the optical axis.

    The plane with the most similar features is refined by two Gauss-Newton steps along the ray,
    towards the sub-cell peaks of similarity in the other views.

    Args:
        view: the view.
        others: see `select_source_views`; without other views the guess is returned.
        guess_m: (h * w,) rough depths, metres.
        scale: factor on the depths that are searched, see `NEAR_M`.

    Returns:
        (h * w,) per metre, within 1 / 12 and 1 / 0.25 over the scale.
    """
    least, most = 1 / (scale * FAR_M), 1 / (scale * NEAR_M)
    guess = torch.from_numpy((1 / guess_m).clip(least, most)).float()
    if not others:
        return guess
    sources = [_SourceView(view, other) for other in others]
    planes = torch.linspace(least, most, PLANES)
    spread = planes.expand(len(guess), PLANES)
    similarity = torch.stack([source.along(spread) for source in sources])
    score = similarity.topk(min(SEEN_BY, len(sources)), 0).values.mean(0)
    volume = score.T.reshape(1, PLANES, *view.grid)
    near = F.avg_pool2d(volume, 3, 1, 1, count_include_pad=False)
    score = (volume + SMOOTHING * (near - volume)).view(PLANES, -1).T
    inverse = planes[score.argmax(1)]
    for _ in range(2):
        gradient, hessian = torch.zeros_like(inverse), torch.full_like(inverse, 1e-3)
        for source in sources:
            slope, curvature = source.normal_equation(inverse)
            gradient, hessian = gradient + slope, hessian + curvature
        step = (gradient / hessian).clamp(-0.1 / scale, 0.1 / scale)
        inverse = (inverse + step).clamp(least, most)
    return inverse


class _SourceView:
    """Similarity of the cells of a view to all cells of one other view."""

    def __init__(self, view: PosedCells, other: PosedCells):
        self.other, (self.rows, self.columns) = other, other.grid
        other_from_view = other.base_from_camera.inverse() @ view.base_from_camera
        self.ray = view.rays() @ other_from_view.rotation_matrix().T
        self.translation = other_from_view.translation_m
        self.similarity = (view.features @ other.features.T).view(-1, *other.grid)

    def pixels(self, inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (..., 2) of cells at inverse depths (cells, ...), and whether they are visible."""
        ray = self.ray.reshape(len(self.ray), *[1] * (inverse.ndim - 1), 3)
        point = ray + inverse[..., None] * self.translation
        front = point[..., 2] > 0.05
        pixels = self.other.camera.project(np.where(front[..., None], point, [0, 0, 1]))
        return np.nan_to_num(pixels), front & np.isfinite(pixels).all(-1)

    def along(self, inverse: Tensor) -> Tensor:
        """(cells, planes) similarity at inverse depths, 0 outside this view."""
        pixels, front = self.pixels(inverse.double().numpy())
        size = np.array([self.columns, self.rows]) * self.other.stride
        inside = front & (pixels > -4).all(-1) & (pixels < size + 4).all(-1)
        grid = torch.from_numpy((pixels + 0.5) / size * 2 - 1).float()
        sampled = F.grid_sample(
            self.similarity[:, None], grid[:, None], align_corners=False, padding_mode="border"
        )
        return sampled[:, 0, 0].clamp(min=0) * torch.from_numpy(inside)

    def normal_equation(self, inverse: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient and Hessian (cells,) of least squares in the inverse depth of each cell."""
        rho = inverse.double().numpy()
        pixels, front = self.pixels(rho)
        delta = 1e-4
        slope = torch.from_numpy((self.pixels(rho + delta)[0] - pixels) / delta).float()
        here = torch.from_numpy(pixels).float()
        stride = self.other.stride
        cell = ((here - (stride - 1) / 2) / stride).round()
        last = torch.tensor([self.columns - 2, self.rows - 2])
        inside = torch.from_numpy(front) & (cell >= 1).all(1) & (cell <= last).all(1)
        column, row = cell.clamp(min=1).minimum(last.float()).long().unbind(1)
        position, similarity = peak(self.similarity, row, column)
        residual = stride * position + (stride - 1) / 2 - here
        weight = inside * (similarity - MIN_PEAK_SIMILARITY).clamp(min=0) ** 2
        weight = weight / (1 + (residual.norm(dim=1) / OUTLIER_PX) ** 2)
        return weight * (slope * residual).sum(1), weight * (slope * slope).sum(1)


def peak(similarity: Tensor, row: Tensor, column: Tensor) -> tuple[Tensor, Tensor]:
    """The most similar cell of the 3x3 around a cell, to a fraction of a cell.

    The similarity (n, h, w) is that of n cells to all cells of another view; rows and columns (n,)
    lie inside its border. Returns (n, 2) column and row, and the similarity (n,) of the nearest
    cell.
    """
    _, height, width = similarity.shape
    n = torch.arange(len(similarity))
    steps = torch.tensor([(v, u) for v in (-1, 0, 1) for u in (-1, 0, 1)])
    patch = similarity[n[:, None], row[:, None] + steps[:, 0], column[:, None] + steps[:, 1]]
    best = steps[patch.argmax(1)]
    row = (row + best[:, 0]).clamp(1, height - 2)
    column = (column + best[:, 1]).clamp(1, width - 2)
    middle = similarity[n, row, column]
    du = parabola(similarity[n, row, column - 1], middle, similarity[n, row, column + 1])
    dv = parabola(similarity[n, row - 1, column], middle, similarity[n, row + 1, column])
    return torch.stack([column + du, row + dv], 1), middle


def parabola(before: Tensor, middle: Tensor, after: Tensor) -> Tensor:
    """Maximum of a parabola through three values, relative to the middle; at most half a step."""
    curvature = (before - 2 * middle + after).clamp(max=-1e-3)
    return (0.5 * (before - after) / curvature).clamp(-0.5, 0.5)
