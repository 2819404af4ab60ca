"""A map's place in the robot's base frame from points that the tool has touched.

Every point is known in the base frame and was picked in images that the map can locate. The pixels
say where the points lie in the map; seven numbers (rotation, translation, scale) bring them
together, found by least squares of the distances in the images.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, cross_matrix
from evercal.mapping.scene_maps import Alignment

Array = NDArray[np.float64]
PICK_SIGMA_PX = 1.0
"""Least standard deviation of a pixel that a person picked."""


@dataclass(frozen=True, eq=False)
class Picks:
    """One image with the points that were picked in it."""

    map_from_camera: SE3
    """Single: where the map has the image's camera."""
    camera: Camera
    """Intrinsics of the image."""
    points: Array
    """(k, 3) of the points, base frame, metres."""
    names: tuple[str, ...]
    """(k,) of the points."""
    pixels: Array
    """(k, 2)."""


@dataclass(frozen=True, eq=False)
class PointAlignment:
    """Where the map was found."""

    alignment: Alignment
    """From the map to the base frame."""
    covariance: Array
    """(7, 7) of a small motion (v, w) of the base frame, metres and radians, and of the logarithm
    of the scale."""
    residual_px: float
    """Root mean square distance of the picks."""


def align_by_points(images: Sequence[Picks], scale_known: bool) -> PointAlignment:
    """Finds where a map lies in the base frame.

    Args:
        images: with at least three named points that are not on one line; each point in two images
            that look from different places.
        scale_known: whether the map is in metres.

    Raises:
        InputError: too few points, or all on one line.
    """
    found = _triangulated(images)
    if len(found) < 3:
        raise InputError(
            f"{len(found)} points were picked in two or more images; give at least three, each in"
            " two images from different places"
        )
    in_map, in_base = (np.stack(side) for side in zip(*found.values(), strict=True))
    start = _umeyama(in_map, in_base, scale_known)
    centre = in_base.mean(0)

    def placed(small: Array) -> Alignment:
        grown = start.scale * (1.0 if scale_known else float(np.exp(small[6])))
        turn = Rotation.from_rotvec(small[3:6])
        place = start.base_from_map.translation_m - centre
        kept = Rotation.from_quat(start.base_from_map.rotation_wxyz, scalar_first=True)
        both = (turn * kept).as_quat(canonical=True, scalar_first=True)
        growth = grown / start.scale
        return Alignment(SE3(both, turn.apply(place) * growth + centre + small[:3]), grown)

    def residuals(small: Array) -> Array:
        return np.concatenate([_distances(image, placed(small)) for image in images])

    fit = least_squares(residuals, np.zeros(6 if scale_known else 7), loss="cauchy", f_scale=2.0)
    off = residuals(fit.x)
    spare = max(len(off) - len(fit.x), 1)
    sigma = max(float(np.sqrt((off**2).sum() / spare)), PICK_SIGMA_PX)
    small = sigma**2 * np.linalg.inv(fit.jac.T @ fit.jac)
    covariance = np.zeros((7, 7))
    covariance[: len(fit.x), : len(fit.x)] = small
    # From a motion about the points' centre to one about the base's origin.
    slope = np.eye(7)
    slope[:3, 3:6] = cross_matrix(centre)
    rms = float(np.sqrt((off.reshape(-1, 2) ** 2).sum(1).mean()))
    return PointAlignment(placed(fit.x), slope @ covariance @ slope.T, rms)


def _distances(image: Picks, alignment: Alignment) -> Array:
    """(2k,) pixels between picks and projections."""
    back = alignment.base_from_map.inverse().apply(image.points) / alignment.scale
    at = image.camera.project(image.map_from_camera.inverse().apply(back))
    return np.nan_to_num(at - image.pixels, nan=1e3).ravel()


def _triangulated(images: Sequence[Picks]) -> dict[str, tuple[Array, Array]]:
    """By name the point in the map and in the base, of points that two images show."""
    rays: dict[str, list[tuple[Array, Array]]] = {}
    base: dict[str, Array] = {}
    for image in images:
        turn = image.map_from_camera.rotation_matrix()
        for name, point, pixel in zip(image.names, image.points, image.pixels, strict=True):
            ray = turn @ image.camera.unproject(pixel)
            if not np.isfinite(ray).all():
                continue
            rays.setdefault(name, []).append(
                (image.map_from_camera.translation_m, ray / np.linalg.norm(ray))
            )
            base[name] = point
    found = {}
    for name, seen in rays.items():
        across = [np.eye(3) - np.outer(ray, ray) for _, ray in seen]
        total = np.sum(across, axis=0)
        if len(seen) < 2 or np.linalg.cond(total) > 1e6:
            continue
        right = np.sum([a @ place for a, (place, _) in zip(across, seen, strict=True)], axis=0)
        found[name] = (np.linalg.solve(total, right), base[name])
    return found


def _umeyama(source: Array, target: Array, scale_known: bool) -> Alignment:
    """Least squares similarity (Umeyama, PAMI 1991).

    Raises:
        InputError: all points on one line.
    """
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
    return Alignment(SE3(rotation.as_quat(canonical=True, scalar_first=True), shift), scale)
