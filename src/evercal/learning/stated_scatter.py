"""Scatter of the stated frame about the map, fitted when a scene is learned."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import LeftOut, MapContents, SceneMap
from evercal.recordings.frame import Frame
from evercal.recordings.images import as_rgb

LEAST_ANSWERS, WRONG_PLACE_M = 8, 0.5
"""Least number of answers that the scatter is fitted to. Answers farther than this from the stated
pose are outliers and are ignored."""


def with_scatter(
    contents: MapContents,
    held_out: Sequence[Frame],
    left_out: Sequence[LeftOut] = (),
    noise: tuple[float, float] = (0.0, 0.0),
) -> SceneMap:
    """The newest scene of a map, with the scatter of its stated frame.

    The scatter is as large as the errors of frames ask for that the map was not built from, aligned
    from their stated poses.

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
    answers = _located(localizer, held_out, scene)
    for part in left_out:
        few = localizer.only(len(others), part.keyframes)
        answers += _located(few, part.frames, scene)
    answers = [
        answer for answer in answers if np.linalg.norm(answer.off[:3]) < WRONG_PLACE_M
    ]
    if len(answers) < LEAST_ANSWERS:
        return scene
    off = np.array([answer.off for answer in answers])
    spread = np.array([answer.covariance for answer in answers])
    spread = spread + np.diag(np.repeat(np.square(noise), 3))
    metres, radians = (
        max(known, scatter(off[:, part], spread[:, part, part]))
        for known, part in zip(
            scene.frame.frame_sigma, (slice(0, 3), slice(3, 6)), strict=True
        )
    )
    return replace(scene, frame=replace(scene.frame, frame_sigma=(metres, radians)))


class _Answer(NamedTuple):
    """A located frame beside its stated pose."""

    off: np.ndarray
    """(6,) translation in the base frame, unit of the map, and rotation about camera axes,
    radians."""
    covariance: np.ndarray
    """(6, 6)."""


def _located(
    localizer: Localizer, frames: Sequence[Frame], scene: SceneMap
) -> list[_Answer]:
    answers = []
    size = np.repeat([scene.frame.scale, 1.0], 3)
    index = localizer.scenes.index(scene.name)
    for frame in frames:
        if (stated := frame.base_from_camera) is None:
            continue
        start = scene.frame.from_base(stated)
        image = as_rgb(frame.read_image())
        estimate = localizer.from_pose(image, frame.camera, index, start)
        pose = estimate and estimate.uncertain_pose
        if pose is not None and np.isfinite(pose.covariance).all():
            turn = (pose.pose.inverse() @ stated).log()[3:]
            off = np.r_[stated.translation_m - pose.pose.translation_m, turn]
            answers.append(_Answer(off / size, pose.covariance / np.outer(size, size)))
    return answers


def scatter(errors: np.ndarray, covariances: np.ndarray) -> float:
    """Smallest standard deviation per axis that makes errors fit their covariances.

    Errors are (n, 3), covariances (n, 3, 3). With the variance added to every axis, 90 % of the
    squared Mahalanobis distances are below the 90 % quantile of their distribution. It is 0 where
    they are without it.
    """
    from scipy.optimize import brentq
    from scipy.special import chdtri

    values, axes = np.linalg.eigh(covariances)
    values = np.maximum(values, 1e-18)
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
