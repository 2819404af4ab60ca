"""Threshold and covariance of a scene, fitted when it is learned."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.geometry.near import COARSE
from evercal.localization.acceptance import COVARIANCE_SCALE, MAX_SUPPORT, MIN_SUPPORT
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import SHARED_PX, LeftOut, MapContents, SceneMap
from evercal.recordings.frame import Frame

AGREE_SQUARES = 7.29
"""80 % quantile of the squared deviation of five intrinsics (chi-squared)."""
LEAST_SHARED_PX = 0.01
"""Frames near the recorded path agree better than others, so no map counts as more exact."""
LEAST_ANSWERS, WRONG_PLACE_M = 8, 0.5
"""Least number of answers that the scatter is fitted to. Answers farther than this from the stated
pose are outliers and are ignored."""


def fit_acceptance(
    contents: MapContents,
    held_out: Sequence[Frame],
    index: int = -1,
    left_out: Sequence[LeftOut] = (),
    noise: tuple[float, float] = (0.0, 0.0),
) -> SceneMap:
    """Fit threshold and covariance of a scene to frames that its map was not built from.

    The threshold is half of the 5 % quantile of the support of well-located frames, between
    `MIN_SUPPORT` and `MAX_SUPPORT`. The scatter of the stated frame is as large as the errors of
    all given frames ask for. The errors that landmarks share explain the intrinsics of these
    frames, see `shared_px`.

    Args:
        contents: The map.
        held_out: Frames that the map was not built from.
        index: The scene; the newest by default.
        left_out: Frames that are located without the keyframes near them.
        noise: Standard deviation of stated poses per axis, metres and radians, that is independent
            from frame to frame. It averages out in the map and is no error of an answer.
    """
    scenes = list(contents.scenes)
    shared = scenes[index].frame.frame_sigma
    bare = replace(scenes[index].frame, frame_sigma=(0.0, 0.0))
    scene = replace(
        scenes[index], frame=bare, min_support=MIN_SUPPORT, covariance_scale=COVARIANCE_SCALE
    )
    scenes[index] = scene
    answers = _located(replace(contents, scenes=scenes), held_out, scene.name)
    supports = [answer.support for answer in answers if answer.near(scene.unit_known)]
    low = float(np.quantile(supports, 0.05)) if supports else 2 * MAX_SUPPORT
    threshold = min(max(low / 2, MIN_SUPPORT), MAX_SUPPORT)
    for part in left_out:
        scenes[index] = replace(scene, keyframes=scene.keyframes.take(part.keyframes))
        answers += _located(replace(contents, scenes=scenes), part.frames, scene.name)
    answers = [answer for answer in answers if answer.support >= threshold]
    if scene.unit_known:
        answers = [answer for answer in answers if np.linalg.norm(answer.off[:3]) < WRONG_PLACE_M]
    if len(answers) >= LEAST_ANSWERS:
        off = np.array([answer.off for answer in answers])
        spread = np.array([answer.covariance for answer in answers])
        spread = spread + np.diag(np.repeat(np.square(noise), 3))
        metres, radians = (
            max(known, scatter(off[:, part], spread[:, part, part]))
            for known, part in zip(shared, (slice(0, 3), slice(3, 6)), strict=True)
        )
        shared = metres, radians
    return replace(
        scene,
        frame=replace(bare, frame_sigma=shared),
        min_support=threshold,
        shared_px=shared_px([answer.measured for answer in answers if answer.measured]),
    )


class _Answer(NamedTuple):
    """A located frame beside its stated pose."""

    support: float
    off: np.ndarray
    """(6,) translation in the base frame, metres, and rotation about camera axes, radians."""
    covariance: np.ndarray
    """(6, 6)."""
    measured: tuple[float, float] | None
    """`squares` and `by_shared` of `RefinedPose`."""

    def near(self, metric: bool) -> bool:
        """Whether the frame is well located; by its rotation where the unit is unknown."""
        metres, radians = np.linalg.norm(self.off.reshape(2, 3), axis=1)
        return bool((metres < COARSE[0] or not metric) and radians < COARSE[1])


def _located(contents: MapContents, frames: Sequence[Frame], scene: str) -> list[_Answer]:
    localizer, answers = Localizer(contents), []
    for frame in frames:
        estimate, found = localizer.located(frame.read_image(), frame.camera)
        pose, stated = estimate.uncertain_pose, frame.base_from_camera
        if pose is None or stated is None or estimate.scene != scene:
            continue
        if np.isfinite(pose.covariance).all():
            turn = (pose.pose.inverse() @ stated).log()[3:]
            off = np.r_[stated.translation_m - pose.pose.translation_m, turn]
            refined = found.refined
            measured = None if refined is None else (refined.squares, refined.by_shared)
            answers.append(_Answer(estimate.support, off, pose.covariance, measured))
    return answers


def shared_px(measured: Sequence[tuple[float, float]]) -> float:
    """Errors that landmarks share, from frames of the recording's own camera.

    With them, the intrinsics of 80 % of the frames agree with those of the recording as well as
    80 % of draws from their distribution.
    """
    if len(measured) < LEAST_ANSWERS:
        return SHARED_PX
    squares, by_shared = np.array(measured).T
    needed = (squares / (COVARIANCE_SCALE * AGREE_SQUARES) - 1) / by_shared
    return float(np.sqrt(max(np.quantile(needed, 0.8), LEAST_SHARED_PX**2)))


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
