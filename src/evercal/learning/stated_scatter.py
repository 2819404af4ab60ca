"""Scatter of the stated frame about the map, fitted when a scene is learned."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import LeftOut, MapContents, SceneMap
from evercal.recordings.frame import Frame
from evercal.recordings.images import as_rgb
from evercal.typing import Array

LEAST_ANSWERS = 8
"""Least number of answers that the scatter is fitted to."""
WRONG_PLACE_M = 0.5
"""Answers farther than this from the stated position are outliers, metres."""
LEAST_VARIANCE = 1e-18
"""Least variance of an answer along any direction."""


def with_scatter(
    contents: MapContents,
    held_out: Sequence[Frame],
    left_out: Sequence[LeftOut] = (),
    noise: tuple[float, float] = (0.0, 0.0),
) -> SceneMap:
    """The newest scene of a map, with the scatter of its stated frame.

    Fitted to frames that were held out and aligned from their stated poses: the smallest scatter
    that explains their errors.

    Args:
        contents: The map.
        held_out: Frames that the map was not built from.
        left_out: Frames that are located without the keyframes near them.
        noise: Standard deviation of stated poses per axis, metres and radians, that is independent
            from frame to frame. It averages out in the map and is no error of an answer.
    """
    *others, scene = contents.scenes
    # Scatter and its bounds are in the unit of the map.
    bare = replace(scene, frame=replace(scene.frame, frame_sigma=(0.0, 0.0)))
    localizer = Localizer(replace(contents, scenes=[*others, bare]))
    answers = _aligned(localizer, held_out, scene)
    for part in left_out:
        few = localizer.only(len(others), part.keyframes)
        answers += _aligned(few, part.frames, scene)
    if len(answers) < LEAST_ANSWERS:
        return scene
    errors = np.array([answer.error for answer in answers])
    covariances = np.array([answer.covariance for answer in answers])
    covariances = covariances + np.diag(np.repeat(np.square(noise), 3))
    known_metres, known_radians = scene.frame.frame_sigma
    metres = scatter(errors[:, :3], covariances[:, :3, :3])
    radians = scatter(errors[:, 3:], covariances[:, 3:, 3:])
    sigma = (max(known_metres, metres), max(known_radians, radians))
    return replace(scene, frame=replace(scene.frame, frame_sigma=sigma))


class _Answer(NamedTuple):
    """A located frame beside its stated pose."""

    error: Array
    """(6,) translation in the base frame, unit of the map, and rotation about camera axes,
    radians."""
    covariance: Array
    """(6, 6)."""


def _aligned(
    localizer: Localizer, frames: Sequence[Frame], scene: SceneMap
) -> list[_Answer]:
    """Answers of alignments that begin at the stated poses, without outliers."""
    answers = []
    size = np.repeat([scene.frame.scale, 1.0], 3)
    index = localizer.scenes.index(scene.name)
    for frame in frames:
        stated = frame.base_from_camera
        if stated is None:
            continue
        start = scene.frame.from_base(stated)
        image = as_rgb(frame.read_image())
        estimate = localizer.from_pose(image, frame.camera, index, start)
        answer = estimate and estimate.uncertain_pose
        if answer is None or not np.isfinite(answer.covariance).all():
            continue
        rotation = (answer.pose.inverse() @ stated).log()[3:]
        shift = stated.translation_m - answer.pose.translation_m
        error = np.r_[shift, rotation] / size
        if np.linalg.norm(error[:3]) < WRONG_PLACE_M:
            covariance = answer.covariance / np.outer(size, size)
            answers.append(_Answer(error, covariance))
    return answers


def scatter(errors: Array, covariances: Array) -> float:
    """Smallest standard deviation per axis that makes errors fit their covariances.

    Errors are (n, 3), covariances (n, 3, 3). With the variance added to every axis, 90 % of the
    squared Mahalanobis distances are below the 90 % quantile of their distribution. It is 0 where
    they are without it.
    """
    from scipy.optimize import brentq
    from scipy.special import chdtri

    values, axes = np.linalg.eigh(covariances)
    values = np.maximum(values, LEAST_VARIANCE)
    squares = np.einsum("nji,nj->ni", axes, errors) ** 2
    limit = float(chdtri(3, 0.1))

    def excess(sigma: float) -> float:
        distances = (squares / (values + sigma**2)).sum(1)
        # Few frames: a quantile between two of them would follow the worst one.
        return float(np.quantile(distances, 0.9, method="lower")) - limit

    if excess(0.0) <= 0:
        return 0.0
    largest = 2 * float(np.sqrt(squares.sum(1).max()))
    return float(brentq(excess, 0.0, largest))  # pyright: ignore[reportArgumentType]
