"""Acceptance: which poses are answers, and how wide their covariance is.

This file holds the formula of the support, its constants and the decision;
`learning.fit_acceptance` fits the threshold of a scene. `LocalizeOptions` says at which support
further attempts are made.

The support of a pose is

    inlier_ratio * (inliers / matched)^2 * sqrt(inlier_ratio * planned)

The first factor falls where another room is in view. The second falls where patches matched by
chance. The last counts the inliers, as if no more landmarks had been searched than for an
unobstructed image. A hand before the lens lowers the first factor alone.
"""

from dataclasses import replace

import numpy as np

from evercal.geometry import SE3, UncertainPose, pose_distance, pose_distance_mm_deg
from evercal.localization.estimate import CovarianceTerm, PoseEstimate
from evercal.localization.query import Hypothesis
from evercal.mapping.scene_map import SceneMap

MAX_SUPPORT = 0.5
"""Largest threshold. Of the wrong poses measured one had more support (research/map.md)."""
MIN_SUPPORT = 0.14
"""Smallest threshold, for recordings whose stated poses fit the images badly."""
COVARIANCE_SCALE = 1.6
"""Alignment errors of neighbouring patches are correlated, so they exceed residuals."""
USELESS_M = 0.05
"""Answers with a larger standard deviation of the position per axis are rejected."""
APART_SIGMAS, APART_M, APART_RAD = 5.0, 0.01, np.deg2rad(1.0)
"""Poses that differ by less are the same answer."""
FULL_SUPPORT = 4.0
"""Poses with less support get a wider covariance: errors on few surfaces are correlated."""


def support(hypothesis: Hypothesis) -> float:
    """Support of a pose, see the top of this file."""
    ratio = hypothesis.inlier_ratio
    exact = hypothesis.inliers / max(1, hypothesis.matched)
    return ratio * exact**2 * (ratio * hypothesis.planned) ** 0.5


def order(hypothesis: Hypothesis) -> tuple[float, int]:
    """Poses are ordered by their support, and by PnP inliers where they have none."""
    return support(hypothesis), hypothesis.pnp_inliers


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
    if scene.frame.similarity is not None:
        metres = metres * scene.frame.similarity.scale
    far = not scene.unit_known or metres > APART_M or radians > APART_RAD
    return bool(far and own.squared_mahalanobis(other) > APART_SIGMAS**2)


def in_base(
    hypothesis: Hypothesis, scene: SceneMap
) -> tuple[UncertainPose, tuple[CovarianceTerm, ...]]:
    """The answer in the base frame, and the shares of its covariance."""
    wide = widened(hypothesis, scene)
    estimate = scene.frame.to_base(wide)
    if hypothesis.refined is None:
        return estimate, ()

    slope, refined = scene.frame.slope, hypothesis.refined

    def moved(covariance: np.ndarray) -> np.ndarray:
        return slope @ covariance @ slope.T

    scale = np.trace(wide.covariance) / np.trace(refined.pose.covariance)
    lens = moved(scale * refined.by_intrinsics)
    view = moved(wide.covariance) - lens
    poses, stated = (
        moved(np.diag(np.repeat(np.square(sigma), 3)))
        for sigma in (scene.frame.pose_sigma, scene.frame.frame_sigma)
    )
    frame = estimate.covariance - view - lens - poses - stated
    return estimate, (
        CovarianceTerm("view", view),
        CovarianceTerm("lens", lens),
        CovarianceTerm("map", poses),
        CovarianceTerm("stated poses", stated),
        CovarianceTerm("base frame", frame),
    )


def without_pose(best: Hypothesis, evidence: float, milliseconds: float) -> PoseEstimate:
    """A rejection of a pose whose support is `evidence`, without its reason."""
    return PoseEstimate(
        status="unknown_scene",
        reason="",
        scene=None,
        base_from_camera=None,
        covariance=None,
        inliers=best.inliers,
        inlier_ratio=best.inlier_ratio,
        milliseconds=milliseconds,
        support=evidence,
    )


def answer(
    best: Hypothesis,
    scene: SceneMap,
    size: tuple[int, ...],
    milliseconds: float,
    rival: Hypothesis | None = None,
) -> PoseEstimate:
    """The answer for a pose in the map's frame, with another one that fits as well.

    `size` are height and width of the image.
    """
    rejected = without_pose(best, support(best), milliseconds)
    if best.pose is None and not best.pnp_inliers:
        return replace(rejected, status="failed", reason="fewer than 6 inliers")
    if not accepted(best, scene):
        return replace(rejected, reason=rejection(best, scene))
    estimate, terms = in_base(best, scene)
    if rival is not None and rival.pose is not None:
        other = scene.frame.to_base(rival.pose).pose
        mm, deg = pose_distance_mm_deg(estimate.pose, other)
        return replace(
            rejected,
            status="ambiguous",
            reason=_rival_reason(mm, deg, scene.unit_known),
            scene=scene.name,
            alternatives=(estimate.pose, other),
        )
    if scene.unit_known and estimate.sigma_mm > 1000 * USELESS_M:
        wide = f"its position is uncertain by {estimate.sigma_mm:.0f} mm per axis"
        return replace(rejected, reason=wide)
    assert best.points_m is not None, "accepted poses have inliers"
    return replace(
        rejected,
        status="ok",
        scene=scene.name,
        base_from_camera=estimate.pose,
        covariance=estimate.covariance,
        terms=terms,
        pixels=best.pixels,
        points_m=scene.frame.points_to_base(best.points_m),
        camera=best.refined and best.refined.camera.resized(size[1], size[0]),
    )


def _rival_reason(mm: float, deg: float, unit_known: bool) -> str:
    away = f"{mm:.0f} mm, {deg:.1f} deg away" if unit_known else f"{deg:.1f} deg away"
    return f"ambiguous: a second pose {away} fits equally well"
