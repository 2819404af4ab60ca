"""Robust averages of poses."""

import numpy as np

from evercal.geometry.se3 import SE3, dominant_quaternion, pose_distance
from evercal.typing import Array, IntArray


def average_poses(poses: SE3) -> SE3:
    """Robust mean of poses (n,); up to nearly half of them may be outliers.

    Iteratively reweighted mean, started at the medoid. Weights are Tukey's biweight of the distance
    to the current mean, cut at four median distances, in metres and in radians.
    """
    if len(poses.shape) != 1 or len(poses) == 0:
        raise ValueError(
            f"average_poses takes a batch (n,) with n >= 1, got {poses.shape}"
        )
    mean = _medoid(poses)
    for _ in range(50):
        metres, radians = pose_distance(mean, poses)
        weight = _biweight(metres) * _biweight(radians)
        # Poses near in metres and poses near in radians are disjoint.
        if weight.sum() <= 0:
            return mean
        translation = weight @ poses.translation_m / weight.sum()
        quaternions = poses.rotation_wxyz
        outer = np.einsum("n,ni,nj", weight, quaternions, quaternions)
        rotation = dominant_quaternion(outer)
        before = mean
        mean = SE3(rotation, translation)
        if max(pose_distance(before, mean)) < 1e-12:
            break
    return mean


def spread(count: int, most: int) -> IntArray:
    """At most `most` of `count` rows, evenly spread, ascending."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


def _medoid(poses: SE3) -> SE3:
    """The pose with the smallest summed distance to the others, among at most 200 candidates."""
    candidates = spread(len(poses), 200)
    cost = np.zeros(len(candidates))
    for distance in pose_distance(poses[candidates[:, None]], poses[None]):
        # Scaled by their median, distances in metres and in radians can be added.
        cost += distance.sum(1) / max(float(np.median(distance)), 1e-9)
    return poses[candidates[np.argmin(cost)]]


def _biweight(distance: Array) -> Array:
    """Tukey's biweight of (n,) distances, cut at four medians."""
    # The farther of the two middle poses, so that the mean of two poses lies halfway.
    median = float(np.sort(distance)[len(distance) // 2])
    cut = 4.0 * max(median, 1e-9)
    return np.clip(1.0 - (distance / cut) ** 2, 0.0, None) ** 2
