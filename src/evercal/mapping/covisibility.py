"""Which frames show the surfaces of a view: for plane sweeps, and for bundle adjustment."""

from collections.abc import Sequence

import numpy as np

from evercal.geometry import SE3, Camera, unit_vectors
from evercal.mapping.plane_sweep import PosedCells
from evercal.typing import Array, BoolArray

PROBED_CELLS = 64
"""Cells of a view that are projected into other views."""
LITTLE_PARALLAX_RAD = np.deg2rad(4.0)
"""Below this parallax, a view is less useful for a plane sweep."""
GOOD_PARALLAX_RAD = np.deg2rad(20.0)
"""Above this parallax, a view is less useful again."""
MOST_PARALLAX_RAD = np.deg2rad(35.0)
"""From this parallax on, a view is useless."""
MIN_USEFULNESS = 0.1
"""Smallest mean usefulness of a source view."""
LEAST_COSINE = 0.7
"""Cosine of the parallax from which on two views of a surface count as different."""


def select_source_views(
    depth_m: Array,
    view: PosedCells,
    poses: SE3,
    cameras: Sequence[Camera],
    count: int,
) -> list[int]:
    """Select the views that show the surfaces of a view under good parallax.

    Rough depths (h * w,) are those of the cells of the view; poses (n,) are base_from_camera.
    """
    visible, cosine = _shown(depth_m, view, poses, cameras)
    parallax = np.arccos(np.clip(cosine, -1, 1))
    rising = np.clip(parallax / LITTLE_PARALLAX_RAD, 0, 1)
    falling = MOST_PARALLAX_RAD - parallax
    falling = np.clip(falling / (MOST_PARALLAX_RAD - GOOD_PARALLAX_RAD), 0, 1)
    usefulness = np.where(visible, rising * falling, 0).mean(-1)
    best = np.argsort(-usefulness, kind="stable")[:count]
    return best[usefulness[best] > MIN_USEFULNESS].tolist()


def shared_view(
    depth_m: Array,
    view: PosedCells,
    poses: SE3,
    cameras: Sequence[Camera],
) -> Array:
    """(n,) share of a view that each camera shows from a similar direction.

    Arguments are those of `select_source_views`.
    """
    visible, cosine = _shown(depth_m, view, poses, cameras)
    similar = (cosine - LEAST_COSINE).clip(0, 1) / (1 - LEAST_COSINE)
    return np.where(visible, similar, 0).mean(-1)


def _shown(
    depth_m: Array,
    view: PosedCells,
    poses: SE3,
    cameras: Sequence[Camera],
) -> tuple[BoolArray, Array]:
    """Whether each camera shows each probed cell (n, 64), and cosines of the parallax."""
    cells = np.linspace(0, len(depth_m) - 1, PROBED_CELLS).astype(int)
    points = view.base_from_camera.apply(view.rays()[cells] * depth_m[cells, None])
    ray = unit_vectors(points - view.base_from_camera.translation_m)
    others = points - poses.translation_m[:, None]
    local = others @ poses.rotation_matrix()
    visible = local[..., 2] > 0
    local[~visible] = [0, 0, 1]
    for camera in set(cameras):
        rows = [i for i, other in enumerate(cameras) if other == camera]
        pixels = camera.project(local[rows])
        inside = (pixels > 0) & (pixels < [camera.width, camera.height])
        visible[rows] &= inside.all(-1)
    others /= np.linalg.norm(others, axis=-1, keepdims=True) + 1e-9
    return visible, (ray * others).sum(-1)
