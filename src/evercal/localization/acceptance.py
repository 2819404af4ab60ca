"""Which poses are accepted, fitted when a scene is learned.

A pose of a map is accepted by its support: the share of the landmarks that should be visible and
agree with the pose to a pixel, times the square of the share that these are of all whose patch was
found nearby, times the square root of their number, counted as if no more had been looked for than
for an ordinary image. The first factor falls where another room is seen, the second where patches
were found by chance; a hand before the lens lowers the first alone. Without a map it is the share
of the image's patches that agree.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from evercal.geometry import pose_distance, squared_mahalanobis
from evercal.geometry.near import NEAR_M, NEAR_RAD
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_maps import SceneMaps, SceneRecord, with_fit
from evercal.recordings.frame import Frame
from evercal.simulation.box_room import BoxRoom, default_camera

NEGATIVE_ROOM_SEED = 8_990
CHI2_6_MEDIAN = 5.348
ACCEPTANCE_FRACTION = 1 / 6
"""Where the threshold lies between the inlier ratios of negative and of positive images."""


MAX_SUPPORT = 0.5
"""Support that no wrong pose reached, of another room or of the right one with few keyframes
(docs/experiments/map.md)."""
MIN_SUPPORT = 0.14
"""Where the stated poses of a recording fit the images badly, right poses have little support: the
threshold then falls to half of what held-out frames have, but not below this."""
MAP_COVARIANCE_SCALE = 1.3
"""Alignment errors of neighbouring patches go together, so errors are larger than residuals say."""


def fitted_record(maps: SceneMaps, held_out: Sequence[Frame], scene: int = -1) -> SceneRecord:
    """The record of a scene, by default the newest, with its thresholds.

    Args:
        maps: what is known.
        held_out: training frames that were not learned.
        scene: index of the scene.
    """
    record, keyframes = maps.scenes[scene], maps.keyframes[scene]
    if keyframes is None or not keyframes.landmarks:
        return with_fit(record, *fit_threshold(maps, held_out, scene))
    scenes = list(maps.scenes)
    scenes[scene] = replace(record, min_support=MIN_SUPPORT)
    localizer = Localizer(replace(maps, scenes=scenes))
    support = [
        found.support
        for frame in held_out
        if _right(found := localizer.localize(frame.read_image(), frame.camera), frame)
    ]
    low = float(np.quantile(support, 0.05)) if support else 2 * MAX_SUPPORT
    least = min(max(low / 2, MIN_SUPPORT), MAX_SUPPORT)
    return replace(record, min_support=least, covariance_scale=MAP_COVARIANCE_SCALE)


def _right(found: PoseEstimate, frame: Frame) -> bool:
    """Whether a frame was located, and not far from where it is said to be."""
    if found.base_from_camera is None or frame.base_from_camera is None:
        return False
    metres, radians = pose_distance(found.base_from_camera, frame.base_from_camera)
    return bool(metres < NEAR_M and radians < NEAR_RAD)


def fit_threshold(
    maps: SceneMaps, held_out: Sequence[Frame], scene: int = -1
) -> tuple[float, float]:
    """Inlier threshold and covariance scale of a scene, by default the newest.

    Positives are held-out training frames, negatives are views of box rooms nobody ever learned.
    The threshold lies a sixth of the way from the negatives' top to the positives' 5 % quantile:
    positives lie on the trail of the recording, and of a view half a metre beside it far fewer
    cells agree. The scale makes the median of
    the squared Mahalanobis error of well located frames what it is for six Gaussian dimensions.

    Returns:
        (smallest inlier ratio that is accepted, factor on covariances).
    """
    # What was fitted before, such as for another strategy with the same head, must not count twice.
    scenes = list(maps.scenes)
    scenes[scene] = with_fit(scenes[scene], 0.0, 1.0)
    localizer = Localizer(replace(maps, scenes=scenes))
    right, ratios = [], []
    for frame in held_out:
        estimate = localizer.localize(frame.read_image(), frame.camera)
        ratios.append(estimate.inlier_ratio)
        if estimate.base_from_camera is None or frame.base_from_camera is None:
            continue
        metres, radians = pose_distance(estimate.base_from_camera, frame.base_from_camera)
        if metres < 0.25 and radians < np.deg2rad(15) and estimate.covariance is not None:
            error = squared_mahalanobis(
                estimate.base_from_camera, estimate.covariance, frame.base_from_camera
            )
            right.append(error)
    negatives = [localizer.localize(image).inlier_ratio for image in _negative_images(maps, scene)]
    top = float(np.quantile(negatives, 0.95))
    known_low = float(np.quantile(ratios, 0.05)) if ratios else 1.0
    threshold = top + ACCEPTANCE_FRACTION * max(0.0, known_low - top)
    scale = float(np.median(right)) / CHI2_6_MEDIAN if right else 1.0
    return threshold, max(scale, 1.0)


def _negative_images(maps: SceneMaps, scene: int) -> list[np.ndarray]:
    """Views of rooms that are in no scene, at the proportions of the scene's camera."""
    small = maps.scenes[scene].camera.short_side_resized(maps.short_side)
    return _negative_views(small.width, small.height)


@lru_cache(maxsize=4)
def _negative_views(width: int, height: int) -> list[np.ndarray]:
    plain, images = default_camera(width, height), []
    for seed in range(NEGATIVE_ROOM_SEED, NEGATIVE_ROOM_SEED + 4):
        room = BoxRoom(seed, texture_px=192)
        rng = np.random.default_rng(seed)
        images += [room.render(plain, room.random_view(rng)) for _ in range(4)]
    return images
