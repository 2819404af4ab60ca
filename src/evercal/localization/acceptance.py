"""Acceptance: which poses are answers, and how wide their covariance is.

This file holds the formula of the support, its constants, the fit of a scene's threshold and the
decision. `LocalizeOptions` says at which support further attempts are made.

The support of a pose is

    inlier_ratio * (inliers / matched)^2 * sqrt(inlier_ratio * planned)

The first factor falls where another room is in view. The second falls where patches matched by
chance. The last counts the inliers, as if no more landmarks had been searched than for an
unobstructed image. A hand before the lens lowers the first factor alone.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.geometry import SE3, UncertainPose, pose_distance
from evercal.geometry.near import NEAR_M, NEAR_RAD
from evercal.localization.estimate import CovarianceTerm
from evercal.localization.query import Hypothesis
from evercal.mapping.scene_map import LeftOut, MapContents, SceneMap
from evercal.recordings.frame import Frame

MAX_SUPPORT = 0.5
"""Largest threshold. One wrong pose of those measured had more support: an image of another room
with the same curtain (docs/experiments/map.md)."""
MIN_SUPPORT = 0.14
"""Smallest threshold. Where stated poses fit the images badly, right poses have little support: the
threshold is then half of the support of held-out frames, but at least this."""
COVARIANCE_SCALE = 1.6
"""Alignment errors of neighbouring patches are correlated, so errors exceed residuals. Chosen on
training frames that are no keyframes (docs/experiments/map.md)."""
USELESS_M = 0.05
"""Answers with a larger standard deviation of the position per axis are rejected."""
APART_SIGMAS, APART_M, APART_RAD = 5.0, 0.01, np.deg2rad(1.0)
"""Poses that differ by less are the same answer."""
FULL_SUPPORT = 4.0
"""Poses with less support get a wider covariance (docs/experiments/map.md): few landmarks lie on
few surfaces, so their errors are correlated."""


def support(hypothesis: Hypothesis) -> float:
    """Support of a pose, see the top of this file."""
    ratio = hypothesis.inlier_ratio
    exact = hypothesis.inliers / max(1, hypothesis.matched)
    return ratio * exact**2 * (ratio * hypothesis.planned) ** 0.5


def better(trial: Hypothesis, best: Hypothesis) -> bool:
    """Whether a pose has more support, or more PnP inliers where neither pose has any."""
    return (support(trial), trial.pnp_inliers) > (support(best), best.pnp_inliers)


def accepted(hypothesis: Hypothesis, scene: SceneMap, times: float = 1.0) -> bool:
    """Whether a pose has enough support in its scene."""
    return hypothesis.inliers > 0 and support(hypothesis) >= times * scene.min_support


def rejection(hypothesis: Hypothesis, scene: SceneMap) -> str:
    """Why a pose is not accepted."""
    share = f"{100 * hypothesis.inlier_ratio:.0f} %"
    return (
        f"{hypothesis.inliers} inliers, {share} of the landmarks that should be visible:"
        f" support {support(hypothesis):.2f}, {scene.name} requires {scene.min_support:.2f}"
    )


def widened(hypothesis: Hypothesis, scene: SceneMap) -> UncertainPose:
    """The pose of a hypothesis with the covariance that its support and its scene ask for."""
    assert hypothesis.pose is not None, "a hypothesis without a pose is never accepted"
    few = FULL_SUPPORT / max(support(hypothesis), 1e-9) if hypothesis.inliers else 1.0
    scale = scene.covariance_scale * max(1.0, few)
    return UncertainPose(hypothesis.pose.pose, scale * hypothesis.pose.covariance)


def differ(hypothesis: Hypothesis, other: SE3, scene: SceneMap) -> bool:
    """Whether another pose, map_from_camera, is outside the uncertainty of an accepted one."""
    own = widened(hypothesis, scene)
    metres, radians = pose_distance(own.pose, other)
    far = metres > APART_M or radians > APART_RAD
    return bool(far and own.squared_mahalanobis(other) > APART_SIGMAS**2)


def in_base(
    hypothesis: Hypothesis, scene: SceneMap
) -> tuple[UncertainPose, tuple[CovarianceTerm, ...]]:
    """The answer in the base frame, and the shares of its covariance."""
    wide = widened(hypothesis, scene)
    estimate = scene.frame.to_base(wide)
    if hypothesis.refined is None:
        return estimate, ()

    def moved(covariance: np.ndarray, **frame: object) -> np.ndarray:
        pose = UncertainPose(wide.pose, covariance)
        return replace(scene.frame, base_covariance=None, **frame).to_base(pose).covariance

    scale = np.trace(wide.covariance) / np.trace(hypothesis.refined.pose.covariance)
    exact, nothing = (0.0, 0.0), np.zeros((6, 6))
    lens = moved(scale * hypothesis.refined.by_intrinsics, pose_sigma=exact, frame_sigma=exact)
    view = moved(wide.covariance, pose_sigma=exact, frame_sigma=exact) - lens
    poses, stated = moved(nothing, frame_sigma=exact), moved(nothing, pose_sigma=exact)
    frame = estimate.covariance - view - lens - poses - stated
    return estimate, (
        CovarianceTerm("view", view),
        CovarianceTerm("lens", lens),
        CovarianceTerm("map", poses),
        CovarianceTerm("stated poses", stated),
        CovarianceTerm("base frame", frame),
    )


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
    all given frames ask for.

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
    answers = _located(replace(contents, scenes=scenes), held_out)
    supports = [answer.support for answer in answers if answer.near]
    for part in left_out:
        scenes[index] = replace(scene, keyframes=scene.keyframes.take(part.keyframes))
        answers += _located(replace(contents, scenes=scenes), part.frames)
    low = float(np.quantile(supports, 0.05)) if supports else 2 * MAX_SUPPORT
    threshold = min(max(low / 2, MIN_SUPPORT), MAX_SUPPORT)
    if answers:
        off = np.array([answer.off for answer in answers])
        spread = np.array([answer.covariance for answer in answers])
        spread = spread + np.diag(np.repeat(np.square(noise), 3))
        metres, radians = (
            max(known, scatter(off[:, part], spread[:, part, part]))
            for known, part in zip(shared, (slice(0, 3), slice(3, 6)), strict=True)
        )
        shared = metres, radians
    return replace(scene, frame=replace(bare, frame_sigma=shared), min_support=threshold)


class _Answer(NamedTuple):
    """A located frame beside its stated pose."""

    support: float
    off: np.ndarray
    """(6,) translation in the base frame, metres, and rotation about camera axes, radians."""
    covariance: np.ndarray
    """(6, 6)."""

    @property
    def near(self) -> bool:
        """Whether the frame is well located."""
        metres, radians = np.linalg.norm(self.off.reshape(2, 3), axis=1)
        return bool(metres < NEAR_M and radians < NEAR_RAD)


def _located(contents: MapContents, frames: Sequence[Frame]) -> list[_Answer]:
    from evercal.localization.localizer import Localizer

    localizer, answers = Localizer(contents), []
    for frame in frames:
        estimate = localizer.localize(frame.read_image(), localizer.camera_for(frame.camera))
        pose, stated = estimate.uncertain_pose, frame.base_from_camera
        if pose is not None and stated is not None:
            turn = (pose.pose.inverse() @ stated).log()[3:]
            off = np.r_[stated.translation_m - pose.pose.translation_m, turn]
            answers.append(_Answer(estimate.support, off, pose.covariance))
    return answers


def scatter(errors: np.ndarray, covariances: np.ndarray) -> float:
    """Smallest standard deviation per axis that makes errors fit their covariances.

    Errors are (n, 3), covariances (n, 3, 3). With the variance added to every axis, 90 % of the
    squared Mahalanobis distances are below the 90 % quantile of their distribution. It is 0 where
    they are without it.
    """
    from scipy.optimize import brentq
    from scipy.stats import chi2

    values, axes = np.linalg.eigh(covariances)
    squares = np.einsum("nji,nj->ni", axes, errors) ** 2
    limit = float(chi2.ppf(0.9, 3))

    def excess(sigma: float) -> float:
        distances = (squares / (values + sigma**2)).sum(1)
        # Few frames: a quantile between two of them would follow the worst one.
        return float(np.quantile(distances, 0.9, method="lower")) - limit

    if excess(0.0) <= 0:
        return 0.0
    largest = 2 * float(np.sqrt(squares.sum(1).max()))
    return float(brentq(excess, 0.0, largest))  # pyright: ignore[reportArgumentType]
