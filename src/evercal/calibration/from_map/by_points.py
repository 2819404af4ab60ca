"""Base frame of a map by points that the tool has touched and that are picked in images."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evercal.calibration.from_map.align import MapAlignment, about, in_own_frame
from evercal.calibration.located import locate
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, axis_deviation, cross_matrix
from evercal.localization.intrinsics import cameras_in_scenes
from evercal.mapping.map_frame import Similarity
from evercal.storage.text_files import few
from evercal.typing import Array, ArrayPair, Image, Strings

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer

PICK_SIGMA_PX = 1.0
"""Assumed standard deviation of a pixel that a person picked."""
ASSUMED = 8
"""Residuals that this assumption is worth."""


_POSE_STEP = 1e-6
"""Step of numerical derivatives, unit of the map and radians."""


def align_by_points(
    localizer: "Localizer",
    scene: str,
    points: Mapping[str, Array],
    picks: Sequence[tuple[str, Image, Mapping[str, Array]]],
    scale_known: bool = True,
    scale_sigma: float = 0.0,
) -> MapAlignment:
    """Estimate the base frame from touched points.

    Args:
        localizer: Localizer of the store.
        scene: Name of the scene.
        points: (3,) by name, base frame, metres.
        picks: (name, (h, w, 3) uint8 RGB, pixels (2,) by name of the point) of each image.
        scale_known: Whether the scene was learned in metres.
        scale_sigma: Standard deviation of the scale of the points, as a share.
    """
    images = located_picks(localizer, scene, points, picks)
    similarity, whole, residual_px = fit_picks(images, scale_known)
    middle = np.mean([*points.values()], axis=0)
    cameras = SE3.stack([image.map_from_camera for image in images])
    away = similarity.points(cameras.translation_m) - middle
    covariance = whole[:6, :6].copy()
    if not scale_known:
        by_scale = (whole[6, 6] + scale_sigma**2) * (away**2).sum(1).mean() / 3
        covariance[:3, :3] += np.eye(3) * by_scale
    return MapAlignment(
        similarity,
        covariance,
        len(points),
        len(points),
        f"{residual_px:.1f} px root mean square",
        None,
        axis_deviation(about(-middle, whole[:6, :6])),
    )


def located_picks(
    localizer: "Localizer",
    scene: str,
    points: Mapping[str, Array],
    picks: Sequence[tuple[str, Image, Mapping[str, Array]]],
) -> "list[Picks]":
    """Picks of the images that are located in the own frame of a scene, two at least."""
    localizer = in_own_frame(localizer, scene)
    images = []
    learned = localizer.contents.scene(scene)
    for name, image, pixels in picks:
        [item] = locate(localizer, [(name, image)])
        if not item.is_located or item.estimate.scene != scene:
            continue
        # The pose holds for the intrinsics that were estimated with it.
        camera = item.estimate.camera or cameras_in_scenes(None, image, [learned])[0]
        untouched = [key for key in pixels if key not in points]
        if untouched:
            raise InputError(
                f"{name}: the picks name {few(untouched, points)}, which `points` does not"
                f" give; it gives {few(list(points))}"
            )
        touched = np.stack([points[key] for key in pixels])
        picked = np.stack([*pixels.values()])
        images.append(
            Picks(item.pose, camera, touched, tuple(pixels), picked, item.covariance)
        )
    if len(images) < 2:
        raise InputError(
            f"{len(images)} of {len(picks)} images with picks were located in {scene}; at least"
            " two are needed"
        )
    return images


class Picks(NamedTuple):
    """One image with the points that were picked in it."""

    map_from_camera: SE3
    camera: Camera
    points: Array
    """(k, 3) in the base frame, metres."""
    names: Strings
    pixels: Array
    """(k, 2)."""
    covariance: Array = np.zeros((6, 6))
    """(6, 6) of `map_from_camera`, see `UncertainPose`, unit of the map."""


def fit_picks(
    images: Sequence[Picks], scale_known: bool
) -> tuple[Similarity, Array, float]:
    """Estimate the pose and, unless it is known, the scale of a map in the base frame.

    Also return the covariance (7, 7) of a small motion (v, w) of the base frame and of the
    logarithm of the scale, and the root mean square distance of the picks in pixels.
    """
    found = triangulated(images)
    if len(found) < 3:
        raise InputError(
            f"{len(found)} points were picked in two or more images; give at least three,"
            " each in two images from different places"
        )
    in_map = np.stack([point for point, _ in found.values()])
    in_base = np.stack([point for _, point in found.values()])
    start = umeyama(in_map, in_base, scale_known)
    centre = in_base.mean(0)
    before = start.base_from_map.rotation
    shift = start.base_from_map.translation_m - centre

    def moved(small: Array) -> Similarity:
        growth = 1.0
        if not scale_known:
            growth = float(np.exp(small[6]))
        rotation = Rotation.from_rotvec(small[3:6])
        translation = rotation.apply(shift) * growth + centre + small[:3]
        return Similarity(SE3.of(rotation * before, translation), start.scale * growth)

    weights = [1 / np.hypot(1, _pose_px(image, start)) for image in images]

    def residuals(small: Array) -> Array:
        similarity = moved(small)
        rows = []
        for image, weight in zip(images, weights, strict=True):
            rows.append(weight * _distances(image, similarity))
        return np.concatenate(rows)

    fit = least_squares(
        residuals, np.zeros(6 if scale_known else 7), loss="cauchy", f_scale=2.0
    )
    rest = residuals(fit.x)
    count = len(fit.x)
    freedom = len(rest) - count + ASSUMED
    sigma2 = ((rest**2).sum() + ASSUMED * PICK_SIGMA_PX**2) / freedom
    covariance = np.zeros((7, 7))
    information = fit.jac.T @ fit.jac
    inverse = np.linalg.inv(information)
    covariance[:count, :count] = sigma2 * inverse
    gains = -inverse @ fit.jac.T
    covariance[:count, :count] += _by_poses(images, weights, moved(fit.x), gains)
    # From a motion about the points' centre to one about the base's origin.
    slope = np.eye(7)
    slope[:3, 3:6] = cross_matrix(centre)
    similarity = moved(fit.x)
    pixels = np.concatenate([_distances(image, similarity) for image in images])
    rms = float(np.sqrt(2 * (pixels**2).mean()))
    return similarity, slope @ covariance @ slope.T, rms


def _by_poses(
    images: Sequence[Picks],
    weights: Sequence[float],
    similarity: Similarity,
    gains: Array,
) -> Array:
    """(k, k) covariance of a fit by errors of the poses, with gains (k, m) of its residuals.

    Errors of the poses may be independent, common in the axes of the map, or common in the axes of
    the camera, as by wrong intrinsics. Their shares are unknown, so each counts as the whole.
    """
    ends = np.cumsum([2 * len(image.names) for image in images])
    apart = np.zeros((len(gains), len(gains)))
    alike = np.zeros((2, len(gains), 6))
    usual = np.zeros((2, 6, 6))
    for image, weight, columns in zip(
        images, weights, np.split(gains, ends[:-1], 1), strict=True
    ):
        slope = weight * columns @ _pose_slopes(image, similarity)
        apart += slope @ image.covariance @ slope.T
        own = np.eye(6)
        own[:3, :3] = image.map_from_camera.rotation_matrix()
        common = np.eye(6)
        common[3:, 3:] = own[:3, :3].T
        for kind, axes in enumerate((own, common)):
            alike[kind] += slope @ axes
            usual[kind] += weight**2 * axes.T @ image.covariance @ axes
    usual /= np.sum(np.square(weights))
    return apart + (alike @ usual @ alike.swapaxes(1, 2)).sum(0)


def _pose_px(image: Picks, similarity: Similarity) -> float:
    """Root mean square error of a pixel by the error of the pose."""
    slopes = _pose_slopes(image, similarity)
    return float(np.sqrt(np.mean((slopes @ image.covariance) * slopes) * 6))


def _pose_slopes(image: Picks, similarity: Similarity) -> Array:
    """(2k, 6) change of the pixels of the points by that of the pose, see `UncertainPose`."""
    at = _distances(image, similarity)
    slopes = []
    for step in _POSE_STEP * np.eye(6):
        rotation = image.map_from_camera.rotation * Rotation.from_rotvec(step[3:])
        position = image.map_from_camera.translation_m + step[:3]
        other = image._replace(map_from_camera=SE3.of(rotation, position))
        slopes.append((_distances(other, similarity) - at) / _POSE_STEP)
    return np.transpose(slopes)


def _distances(image: Picks, similarity: Similarity) -> Array:
    in_map = similarity.base_from_map.inverse().apply(image.points) / similarity.scale
    in_camera = image.map_from_camera.inverse().apply(in_map)
    pixels = image.camera.project(in_camera)
    return np.nan_to_num(pixels - image.pixels, nan=1e3).ravel()


def triangulated(images: Sequence[Picks]) -> dict[str, ArrayPair]:
    """Return each point that two images show in the map and in the base, by name."""
    centres = defaultdict(list)
    across = defaultdict(list)
    base: dict[str, Array] = {}
    for image in images:
        rotation = image.map_from_camera.rotation_matrix()
        for name, point, pixel in zip(
            image.names, image.points, image.pixels, strict=True
        ):
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


def require_spread(points: Array) -> None:
    """Refuse points (n, 3) on one line."""
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if spread[1] < 0.02 * spread[0]:
        raise InputError(
            "the touched points lie on one line, so what they hold could turn about it; touch a"
            " point beside the line too"
        )


def umeyama(source: Array, target: Array, scale_known: bool) -> Similarity:
    """The similarity that moves points (n, 3) to others (n, 3), by least squares."""
    a = source - source.mean(0)
    b = target - target.mean(0)
    require_spread(b)
    rotation = Rotation.align_vectors(b, a)[0]
    scale = 1.0
    if not scale_known:
        scale = float((b * rotation.apply(a)).sum() / (a**2).sum())
    shift = target.mean(0) - scale * rotation.apply(source.mean(0))
    return Similarity(SE3.of(rotation, shift), scale)
