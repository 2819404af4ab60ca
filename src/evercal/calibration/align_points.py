"""Pose and scale of a map in the robot's base frame, from points that the tool has touched.

Picks in located images give the position of a point in the map. A similarity takes it to its
position in the base frame; reprojection errors are least.
"""

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, cross_matrix
from evercal.mapping.map_frame import Similarity

Array = NDArray[np.float64]
PICK_SIGMA_PX = 1.0
"""Least standard deviation of a pixel that a person picked."""


class Picks(NamedTuple):
    """One image with the points that were picked in it."""

    map_from_camera: SE3
    camera: Camera
    points: Array
    """(k, 3) in the base frame, metres."""
    names: tuple[str, ...]
    pixels: Array
    """(k, 2)."""


class PointAlignment(NamedTuple):
    """Pose and scale of the map in the base frame."""

    similarity: Similarity
    covariance: Array
    """(7, 7) of a small motion (v, w) of the base frame, and of the logarithm of the scale."""
    residual_px: float
    """Root mean square distance of the picks."""


def align_by_points(images: Sequence[Picks], scale_known: bool) -> PointAlignment:
    """Estimate the pose and, unless it is known, the scale of a map in the base frame."""
    triangulated = _triangulated(images)
    if len(triangulated) < 3:
        raise InputError(
            f"{len(triangulated)} points were picked in two or more images; give at least three,"
            " each in two images from different places"
        )
    in_map, in_base = (np.stack(side) for side in zip(*triangulated.values(), strict=True))
    start = _umeyama(in_map, in_base, scale_known)
    centre = in_base.mean(0)
    before = Rotation.from_quat(start.base_from_map.rotation_wxyz, scalar_first=True)
    shift = start.base_from_map.translation_m - centre

    def moved(small: Array) -> Similarity:
        growth = 1.0 if scale_known else float(np.exp(small[6]))
        rotation = Rotation.from_rotvec(small[3:6])
        both = (rotation * before).as_quat(canonical=True, scalar_first=True)
        translation = rotation.apply(shift) * growth + centre + small[:3]
        return Similarity(SE3(both, translation), start.scale * growth)

    def residuals(small: Array) -> Array:
        return np.concatenate([_distances(image, moved(small)) for image in images])

    fit = least_squares(residuals, np.zeros(6 if scale_known else 7), loss="cauchy", f_scale=2.0)
    off = residuals(fit.x)
    sigma = max(np.sqrt((off**2).sum() / max(len(off) - len(fit.x), 1)), PICK_SIGMA_PX)
    covariance = np.zeros((7, 7))
    covariance[: len(fit.x), : len(fit.x)] = sigma**2 * np.linalg.inv(fit.jac.T @ fit.jac)
    # From a motion about the points' centre to one about the base's origin.
    slope = np.eye(7)
    slope[:3, 3:6] = cross_matrix(centre)
    rms = float(np.sqrt((off.reshape(-1, 2) ** 2).sum(1).mean()))
    return PointAlignment(moved(fit.x), slope @ covariance @ slope.T, rms)


def _distances(image: Picks, similarity: Similarity) -> Array:
    back = similarity.base_from_map.inverse().apply(image.points) / similarity.scale
    at = image.camera.project(image.map_from_camera.inverse().apply(back))
    return np.nan_to_num(at - image.pixels, nan=1e3).ravel()


def _triangulated(images: Sequence[Picks]) -> dict[str, tuple[Array, Array]]:
    """Return each point that two images show in the map and in the base, by name."""
    centres, across = defaultdict(list), defaultdict(list)
    base: dict[str, Array] = {}
    for image in images:
        rotation = image.map_from_camera.rotation_matrix()
        for name, point, pixel in zip(image.names, image.points, image.pixels, strict=True):
            ray = rotation @ image.camera.unproject(pixel)
            if np.isfinite(ray).all():
                across[name].append(np.eye(3) - np.outer(ray, ray) / (ray @ ray))
                centres[name].append(image.map_from_camera.translation_m)
                base[name] = point
    points = {}
    for name, point in base.items():
        total = np.sum(across[name], axis=0)
        if len(across[name]) >= 2 and np.linalg.cond(total) <= 1e6:
            right = np.einsum("nij,nj->i", across[name], centres[name])
            points[name] = (np.linalg.solve(total, right), point)
    return points


def _umeyama(source: Array, target: Array, scale_known: bool) -> Similarity:
    a, b = source - source.mean(0), target - target.mean(0)
    spread = np.linalg.svd(b, compute_uv=False)
    if spread[1] < 0.02 * spread[0]:
        raise InputError(
            "the touched points lie on one line, so the map could turn about it; touch a point"
            " beside the line too"
        )
    rotation = Rotation.align_vectors(b, a)[0]
    scale = 1.0 if scale_known else float((b * rotation.apply(a)).sum() / (a**2).sum())
    shift = target.mean(0) - scale * rotation.apply(source.mean(0))
    return Similarity(SE3(rotation.as_quat(canonical=True, scalar_first=True), shift), scale)
