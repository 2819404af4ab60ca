"""Acceptance of network poses: a threshold on the share of patches that are inliers."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from evercal.continual.localizer import NetworkLocalizer
from evercal.continual.scenes import LearnedScenes, SceneRecord
from evercal.geometry import pose_distance
from evercal.recordings.frame import Frame
from evercal.simulation.box_room import BoxRoom, default_camera
from evercal.typing import Image

NEGATIVE_ROOM_SEED = 8_990
"""Seed of the first box room of negative images."""
_NEGATIVE_ROOMS = 4
"""Number of box rooms of negative images."""
_VIEWS = 4
"""Negative images of each room."""
CHI2_6_MEDIAN = 5.348
"""Median of the chi-squared distribution with six degrees of freedom."""
_NEAR_M = 0.25
"""Position error below which a pose counts for the covariance scale, metres."""
_NEAR_RAD = np.deg2rad(15)
"""Rotation error below which a pose counts for the covariance scale, radians."""
ACCEPTANCE_FRACTION = 1 / 6
"""Position of the threshold between the inlier ratios of negative and positive images."""


def fit_threshold(scenes: LearnedScenes, held_out: Sequence[Frame]) -> SceneRecord:
    """Fit the inlier threshold and covariance scale of the newest scene.

    Positives are held-out training frames; negatives are views of box rooms that were never
    learned. The threshold lies a sixth of the way from the 95 % quantile of the negatives to the
    5 % quantile of the positives: positives lie on the path of the recording, and views beside it
    have fewer inliers. The scale gives well-located frames the median squared Mahalanobis error of
    six Gaussian dimensions. Returned is the scene's record with both.
    """
    # A threshold that was fitted before must not count twice.
    *earlier, newest = scenes.scenes
    newest = replace(newest, inlier_threshold=0.0, covariance_scale=1.0)
    localizer = NetworkLocalizer(replace(scenes, scenes=[*earlier, newest]))
    squared = []
    positives = []
    for frame in held_out:
        estimate = localizer.localize(frame.read_image(), frame.camera)
        positives.append(estimate.inlier_ratio)
        pose = estimate.uncertain_pose
        if not pose or not frame.base_from_camera:
            continue
        metres, radians = pose_distance(pose.pose, frame.base_from_camera)
        if metres < _NEAR_M and radians < _NEAR_RAD:
            squared.append(pose.squared_mahalanobis(frame.base_from_camera))
    small = newest.camera.short_side_resized(scenes.short_side)
    others = _negative_views(*small.size)
    negatives = [localizer.localize(image).inlier_ratio for image in others]
    high = float(np.quantile(negatives, 0.95))
    low = float(np.quantile(positives or [1.0], 0.05))
    threshold = high + ACCEPTANCE_FRACTION * max(0.0, low - high)
    scale = float(np.median(squared or [CHI2_6_MEDIAN])) / CHI2_6_MEDIAN
    return replace(newest, inlier_threshold=threshold, covariance_scale=max(scale, 1.0))


@lru_cache(maxsize=4)
def _negative_views(width: int, height: int) -> list[Image]:
    camera = default_camera(width, height)
    images = []
    for seed in range(NEGATIVE_ROOM_SEED, NEGATIVE_ROOM_SEED + _NEGATIVE_ROOMS):
        room = BoxRoom(seed, texture_px=192)
        rng = np.random.default_rng(seed)
        for _ in range(_VIEWS):
            images.append(room.render(camera, room.random_view(rng)))
    return images
