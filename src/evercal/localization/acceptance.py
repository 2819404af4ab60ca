"""Which poses are accepted: a scene's smallest inlier ratio, fitted when the scene is learned."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from evercal.datasets.frame import Frame
from evercal.geometry.se3 import pose_distance
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_maps import SceneMaps
from evercal.simulation.box_room import BoxRoom, default_camera

NEGATIVE_ROOM_SEED = 8_990
CHI2_6_MEDIAN = 5.348
ACCEPTANCE_FRACTION = 1 / 6
"""Where the threshold lies between the inlier ratios of negative and of positive images."""


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
    localizer = Localizer(maps)
    right, ratios = [], []
    for frame in held_out:
        estimate = localizer.localize(frame.read_image(), frame.camera)
        ratios.append(estimate.inlier_ratio)
        if estimate.base_from_camera is None or frame.base_from_camera is None:
            continue
        metres, radians = pose_distance(estimate.base_from_camera, frame.base_from_camera)
        if metres < 0.25 and radians < np.deg2rad(15) and estimate.covariance is not None:
            moved = estimate.base_from_camera.inverse() @ frame.base_from_camera
            shift = frame.base_from_camera.translation_m - estimate.base_from_camera.translation_m
            error = np.concatenate([shift, moved.log()[3:]])
            right.append(float(error @ np.linalg.pinv(estimate.covariance) @ error))
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
