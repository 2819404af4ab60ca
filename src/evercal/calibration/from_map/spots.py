"""Covariance of a camera that is located in a map from one spot, or from many.

A camera that stands still observes the scene from one spot. Its images share the errors of their
landmarks, so that part of the covariance does not fall with their number. A camera that moves
observes from many spots, and errors average over the spots.
"""

from collections.abc import Sequence
from typing import NamedTuple, get_args

import numpy as np

from evercal.calibration.calibration import ErrorTerm
from evercal.calibration.located import (
    Fused,
    ImagePose,
    mean_covariance,
    poses_of,
)
from evercal.geometry import SE3, cross_matrix, deviations, pose_distance
from evercal.localization.estimate import Cause
from evercal.typing import Array, IntArray

SPOT_M = 0.1
"""Views closer than this, metres, observe the same landmarks, so they share their errors."""
SPOT_RAD = np.deg2rad(10.0)
"""The same for their rotations, radians."""
LEAST_VARIANCE = 1e-18
"""Least variance that a scatter is compared with."""


class Uncertainty(NamedTuple):
    """A covariance and its causes."""

    covariance: Array
    """(6, 6)."""
    terms: tuple[ErrorTerm, ...]


def from_one_spot(located: Sequence[ImagePose], fused: Fused) -> Uncertainty:
    """Uncertainty of a camera that stands still: of the landmarks, and scatter of the images."""
    used = fused.select(located)
    landmarks = mean_covariance(used)
    scatter = fused.scatter / len(used)
    name = f"scatter of {len(used)} images"
    if len(used) == 1:
        name = "scatter (unknown from one image)"
    terms = (*_by_cause(used), ErrorTerm.of(name, scatter))
    return Uncertainty(landmarks + scatter, terms)


def from_many_spots(
    located: Sequence[ImagePose],
    in_parent: Sequence[ImagePose],
    fused: Fused,
    parent_from_scene: SE3,
    base_covariance: Array | None,
) -> Uncertainty:
    """Uncertainty of a camera that moves in its scene: scatter among spots, one spot, the base.

    Args:
        located: The images with poses in the scene.
        in_parent: The images with the pose of the camera in its parent frame.
        fused: Mean of `in_parent`.
        parent_from_scene: (n,) pose at each image.
        base_covariance: (6, 6) of a motion of the base frame that all poses in the scene share.
    """
    from scipy import stats

    used = fused.select(in_parent)
    cameras = [item.pose for item in fused.select(located)]
    parents = fused.select(list(parent_from_scene))
    spots = _spots(cameras)
    count = int(spots.max()) + 1
    base = np.zeros((6, 6)) if base_covariance is None else base_covariance
    slopes = np.stack([*map(_by_scene_motion, parents, cameras)])
    by_base = slopes.mean(0) @ base @ slopes.mean(0).T
    whole = mean_covariance(used)
    of_base = (slopes @ base @ slopes.transpose(0, 2, 1)).mean(0)
    one_spot = (whole - of_base) / count
    deviation = deviations(poses_of(used), fused.pose)
    means = np.stack([deviation[spots == spot].mean(0) for spot in range(count)])
    freedom = max(count - 1, 1)
    # The scatter contains errors of the robot's poses, which the images do not show.
    scatter = means.T @ means / freedom / count
    larger = np.maximum(np.diag(scatter), np.diag(one_spot))
    scale = np.sqrt(larger / np.maximum(np.diag(one_spot), LEAST_VARIANCE))
    # Student factor of a covariance that was estimated from few spots.
    student = float((stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975)) ** 2)
    covariance = one_spot * np.outer(scale, scale) * student
    terms = [term for term in _by_cause(used, count) if term.name != "base frame"]
    terms.append(ErrorTerm.of("base frame", by_base))
    name = f"arm, and scatter among {count} spots"
    terms.append(ErrorTerm.of(name, covariance - one_spot))
    return Uncertainty(covariance + by_base, tuple(terms))


def _by_scene_motion(parent_from_scene: SE3, scene_from_camera: SE3) -> Array:
    """(6, 6) derivative of the camera in its parent frame by a motion of the scene."""
    rotation = parent_from_scene.rotation_matrix()
    slope = np.zeros((6, 6))
    slope[:3, :3] = rotation
    slope[:3, 3:] = -rotation @ cross_matrix(scene_from_camera.translation_m)
    slope[3:, 3:] = scene_from_camera.rotation_matrix().T
    return slope


def _by_cause(used: Sequence[ImagePose], spots: int = 1) -> tuple[ErrorTerm, ...]:
    """The mean covariance of the images by cause, over the number of spots."""
    total = {name: np.zeros((6, 6)) for name in get_args(Cause)}
    for item in used:
        terms = item.estimate.terms
        if not terms and item.estimate.covariance is not None:
            total["view"] += item.estimate.covariance
        for term in terms:
            total[term.name] += term.covariance
    count = len(used) * spots
    return tuple(ErrorTerm.of(name, total[name] / count) for name in total)


def _spots(poses: Sequence[SE3]) -> IntArray:
    """(n,) number of the spot of each pose; a spot is a pose and those near it."""
    centres: list[SE3] = []
    numbers = []
    for pose in poses:
        number = len(centres)
        for i, centre in enumerate(centres):
            metres, radians = pose_distance(centre, pose)
            if metres < SPOT_M and radians < SPOT_RAD:
                number = i
                break
        if number == len(centres):
            centres.append(pose)
        numbers.append(number)
    return np.array(numbers)
