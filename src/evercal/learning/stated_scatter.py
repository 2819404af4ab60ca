"""Frames of a recording in the map of its scene alone, located or aligned, and what they show.

How far the intrinsics of its camera move from image to image, and how far the stated frame scatters
about the map. The other scenes of the map are left out, so that a scene does not depend on them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from evercal.geometry import SE3, Camera, pose_distance_mm_deg
from evercal.localization.answer import differ, in_base
from evercal.localization.hypothesis import Aligned
from evercal.localization.intrinsics import (
    CERTAINLY_OWN,
    FREE,
    SAME_MODEL,
    IntrinsicsPrior,
)
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import LeftOut, MapContents, SceneMap
from evercal.recordings.frame import Frame
from evercal.recordings.images import as_rgb
from evercal.typing import Array, Floats, Pair, Strings, Triple

LEAST_ANSWERS = 8
"""Least number of answers that errors are estimated from."""
OUTLIER = 6.0
"""An answer with a deviation of more medians is an outlier."""
LEAST_VARIANCE = 1e-18
"""Least variance of an answer along any direction."""
LESS_LIKELY = 1.353
"""The scatter is a bound of 95 %: its likelihood is lower than the largest by this logarithm, half
of the 90 % quantile of chi-squared with one degree of freedom."""
ITERATIONS = 60
"""Of the variances of moving intrinsics; small ones converge slowly, to 0."""


def localizer_of(contents: MapContents, scene: SceneMap) -> Localizer:
    """A localizer of one scene, with the encoder of `contents`."""
    return Localizer(contents.empty().with_scene(scene))


def located_poses(localizer: Localizer, frames: Sequence[Frame]) -> list[SE3 | None]:
    """Pose of each frame in the frame of the scene; None of those that are not located."""
    poses = []
    for frame in frames:
        estimate = localizer.localize(frame.read_image(), frame.camera)
        poses.append(estimate.base_from_camera)
    return poses


def located_as_stated(localizer: Localizer, frames: Sequence[Frame]) -> Strings:
    """Names of the posed frames that are located where their poses say."""
    [scene] = localizer.contents.scenes
    names = []
    for frame in frames:
        estimate, pose = localizer.located(frame.read_image(), frame.camera)
        assert frame.base_from_camera, "a posed frame"
        stated = scene.frame.from_base(frame.base_from_camera)
        if estimate.status != "ok" or not pose or differ(pose, stated):
            continue
        names.append(frame.name)
    return tuple(names)


def with_scatter(
    contents: MapContents,
    held_out: Sequence[Frame],
    left_out: Sequence[LeftOut] = (),
    noise: Pair = (0.0, 0.0),
) -> SceneMap:
    """The newest scene of a map, with the scatter of its intrinsics and of its stated frame.

    Fitted to frames that were held out and aligned from their stated poses.

    Args:
        contents: The map.
        held_out: Frames that the map was not built from.
        left_out: Frames that are located without the keyframes near them.
        noise: Standard deviation of stated poses per axis, metres and radians, that is independent
            from frame to frame. It averages out in the map and is no error of an answer.
    """
    parts = [LeftOut(tuple(held_out), np.arange(len(contents.scenes[-1].keyframes)))]
    parts += left_out
    scene = contents.scenes[-1]
    # Scatter and its bounds are in the unit of the map.
    bare = replace(scene, frame=replace(scene.frame, frame_sigma=(0.0, 0.0)))
    freed = [aligned for _, aligned in _aligned(contents, bare, parts, FREE)]
    if len(freed) < LEAST_ANSWERS:
        return scene
    changes = np.array([aligned.change for aligned in freed])
    measured = np.array([aligned.measured for aligned in freed])
    moving = intrinsics_sigma(changes, measured, freed[0].camera)
    scene = replace(scene, intrinsics_sigma=moving)
    bare = replace(bare, intrinsics_sigma=moving)
    answers = []
    for frame, aligned in _aligned(contents, bare, parts, CERTAINLY_OWN):
        answer = _answer(frame, aligned, bare)
        if np.isfinite(answer.covariance).all():
            answers.append(answer)
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


def held_out_errors(
    contents: MapContents, held_out: Sequence[Frame]
) -> dict[str, Floats]:
    """Distances of frames, aligned in the newest scene, from their stated poses, by name.

    Millimetres and degrees; nothing of a frame that is not aligned.
    """
    scene = contents.scenes[-1]
    part = LeftOut(tuple(held_out), np.arange(len(scene.keyframes)))
    errors: dict[str, Floats] = {frame.name: () for frame in held_out}
    for frame, aligned in _aligned(contents, scene, [part], CERTAINLY_OWN):
        stated = frame.base_from_camera
        if stated:
            estimate, _ = in_base(aligned, scene)
            errors[frame.name] = pose_distance_mm_deg(estimate.pose, stated)
    return errors


def _aligned(
    contents: MapContents,
    scene: SceneMap,
    parts: Sequence[LeftOut],
    prior: IntrinsicsPrior,
) -> Iterator[tuple[Frame, Aligned]]:
    """Frames and alignments that begin at their stated poses, with a prior of intrinsics."""
    index = len(contents.scenes) - 1
    localizer = Localizer(contents.with_replaced(index, scene))
    for part in parts:
        few = localizer.only(index, part.keyframes)
        for frame in part.frames:
            if not frame.base_from_camera:
                continue
            start = scene.frame.from_base(frame.base_from_camera)
            query = localizer.query(as_rgb(frame.read_image()), frame.camera)
            aligned = few.aligned(query, index, start, prior)
            if aligned:
                yield frame, aligned


class _Answer(NamedTuple):
    """A located frame beside its stated pose."""

    error: Array
    """(6,) translation in the base frame, unit of the map, and rotation about camera axes,
    radians."""
    covariance: Array
    """(6, 6)."""


def _answer(frame: Frame, aligned: Aligned, scene: SceneMap) -> _Answer:
    stated = frame.base_from_camera
    assert stated, "only posed frames are aligned"
    estimate, _ = in_base(aligned, scene)
    rotation = (estimate.pose.inverse() @ stated).log()[3:]
    shift = stated.translation_m - estimate.pose.translation_m
    size = np.repeat([scene.frame.scale, 1.0], 3)
    error = np.r_[shift, rotation] / size
    return _Answer(error, estimate.covariance / np.outer(size, size))


def intrinsics_sigma(changes: Array, measured: Array, camera: Camera) -> Triple:
    """Standard deviations of `SceneMap.intrinsics_sigma`, from images that measure intrinsics.

    Changes are (n, 5), their covariances (n, 5, 5). The variances with the greatest likelihood, by
    expectation maximisation: a change c that was measured with the covariance M has the mean K c
    and the covariance V - K V, K = V / (V + M).
    """
    side = max(camera.size)
    variances = SAME_MODEL.variances(camera)
    for _ in range(ITERATIONS):
        gain = variances[:, None] * np.linalg.inv(measured + np.diag(variances))
        mean = np.einsum("nij,nj->ni", gain, changes)
        left = variances - np.einsum("nii->ni", gain * variances)
        squares = (mean**2 + left).mean(0)
        for group in (slice(0, 1), slice(1, 3), slice(3, 5)):
            variances[group] = squares[group].mean()
    focal, centre, _, distortion, _ = np.sqrt(variances).tolist()
    return focal, centre / side, distortion


def scatter(errors: Array, covariances: Array) -> float:
    """Largest standard deviation per axis that errors and their covariances do not contradict.

    Errors are (n, 3), covariances (n, 3, 3). It is added to every axis; see `LESS_LIKELY`.
    """
    from scipy.optimize import brentq, minimize_scalar

    values, axes = np.linalg.eigh(covariances)
    values = np.maximum(values, LEAST_VARIANCE)
    squares = np.einsum("nji,nj->ni", axes, errors) ** 2
    deviations = np.sqrt((squares / values).sum(1))
    usual = deviations <= OUTLIER * np.median(deviations)
    values = values[usual]
    squares = squares[usual]

    def unlikeliness(sigma: float) -> float:
        variances = values + sigma**2
        return float((np.log(variances) + squares / variances).sum()) / 2

    largest = 2 * float(np.sqrt(squares.sum(1).max()))
    minimum: Any = minimize_scalar(
        unlikeliness, bounds=(0.0, largest), method="bounded"
    )
    best = float(minimum.x)
    least = unlikeliness(best)

    def excess(sigma: float) -> float:
        return unlikeliness(sigma) - least - LESS_LIKELY

    return float(brentq(excess, best, 10 * largest))  # pyright: ignore[reportArgumentType]
