"""Acceptance: which poses are answers.

One law and one rate decide. At a wrong pose some landmarks match by chance, and how many differs
from place to place: the inliers among n searched landmarks have a beta-binomial distribution. The
support of a pose is -log10 of the probability that a wrong one has as many inliers. A pose is
accepted where that is below the rate of false accepts.
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from evercal.geometry import SE3, UncertainPose, pose_distance, pose_distance_mm_deg
from evercal.localization.estimate import CovarianceTerm, PoseEstimate
from evercal.localization.query import Hypothesis
from evercal.mapping.scene_map import SceneMap

CHANCE = 17.2, 306.0
"""Beta distribution of the inlier ratio of wrong poses: 0.053 +- 0.012 (research/map.md)."""
SAME_SURFACE = 3
"""Landmarks that show the same piece of a surface from several keyframes and match together."""
FALSE_ACCEPTS = 1e-4
"""Probability that a wrong pose is accepted."""
FULL_SUPPORT = 36.0
"""Poses with less support get a wider covariance: their landmarks are on few surfaces, whose errors
are correlated (research/map.md)."""
USELESS_M = 0.05
"""Answers with a larger standard deviation of the position per axis are `uncertain`."""
APART_SIGMAS, APART_M, APART_RAD = 5.0, 0.01, np.deg2rad(1.0)
"""Poses that differ by less are the same answer."""


def support(hypothesis: Hypothesis) -> float:
    """Support of a pose, see the top of this file; 0 without inliers."""
    return _improbability(hypothesis.inliers, hypothesis.expected)


@lru_cache(maxsize=64)  # one image asks for that of its poses again and again
def _improbability(inliers: int, expected: int) -> float:
    if not inliers:
        return 0.0
    k, n, (a, b) = inliers / SAME_SURFACE, expected / SAME_SURFACE, CHANCE
    more = np.arange(k, n - 1e-6)
    # Logarithms of the probabilities of k, k + 1, ... n inliers, relative to that of k.
    steps = np.log((n - more) / (more + 1) * (more + a) / (n - more - 1 + b))
    relative = np.r_[0.0, np.cumsum(steps)]
    tail = relative.max() + math.log(np.exp(relative - relative.max()).sum())
    choose = math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
    first = choose + _log_beta(k + a, n - k + b) - _log_beta(a, b)
    return max(0.0, -(first + tail) / math.log(10))


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


def order(hypothesis: Hypothesis) -> tuple[float, int]:
    """Poses are ordered by their support, and by PnP inliers where they have none."""
    return support(hypothesis), hypothesis.pnp_inliers


def accepted(hypothesis: Hypothesis, times: float = 1.0) -> bool:
    """Whether a pose has `times` the support that is required."""
    return support(hypothesis) >= -times * math.log10(FALSE_ACCEPTS)


def rejection(hypothesis: Hypothesis, scene: SceneMap) -> str:
    """Why a pose is not accepted."""
    share = f"{100 * hypothesis.inlier_ratio:.0f} %"
    return (
        f"{hypothesis.inliers} inliers, {share} of the landmarks of {scene.name} that should be"
        f" visible: support {support(hypothesis):.1f}, {-math.log10(FALSE_ACCEPTS):.1f} is required"
    )


def widening(hypothesis: Hypothesis) -> float:
    """Factor on the covariance of an accepted pose."""
    return max(1.0, FULL_SUPPORT / support(hypothesis))


def differ(hypothesis: Hypothesis, other: SE3) -> bool:
    """Whether another pose, map_from_camera, is outside the uncertainty of an accepted one."""
    assert hypothesis.pose is not None, "a hypothesis without a pose is never accepted"
    metres, radians = pose_distance(hypothesis.pose.pose, other)
    far = metres > APART_M or radians > APART_RAD
    squares = hypothesis.pose.squared_mahalanobis(other) / widening(hypothesis)
    return bool(far and squares > APART_SIGMAS**2)


def in_base(
    hypothesis: Hypothesis, scene: SceneMap
) -> tuple[UncertainPose, tuple[CovarianceTerm, ...]]:
    """The answer in the base frame, and the shares of its covariance."""
    pose = hypothesis.pose
    assert pose is not None, "a hypothesis without a pose is never accepted"
    wide = UncertainPose(pose.pose, widening(hypothesis) * pose.covariance)
    estimate = scene.frame.to_base(wide)
    if hypothesis.refined is None:
        return estimate, ()

    slope = scene.frame.slope
    refined = hypothesis.refined

    def moved(covariance: np.ndarray) -> np.ndarray:
        return slope @ covariance @ slope.T

    lens = moved(widening(hypothesis) * refined.by_intrinsics)
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


def without_pose(
    best: Hypothesis, evidence: float, milliseconds: float
) -> PoseEstimate:
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
    if not accepted(best):
        return replace(rejected, reason=rejection(best, scene))
    estimate, terms = in_base(best, scene)
    rejected = replace(rejected, parent_frame=scene.parent_frame)
    if rival is not None and rival.pose is not None:
        other = scene.frame.to_base(rival.pose).pose
        mm, deg = pose_distance_mm_deg(estimate.pose, other)
        return replace(
            rejected,
            status="ambiguous",
            reason=_rival_reason(mm, deg, scene.metric),
            scene=scene.name,
            alternatives=(estimate.pose, other),
        )
    metres = scene.at_room_scale(estimate.sigma_mm / 1000)
    if metres > USELESS_M:
        off = (
            f"{1000 * metres:.0f} mm"
            if scene.metric
            else f"{estimate.sigma_mm / 1000:.3g}"
        )
        wide = f"its position is uncertain by {off} per axis"
        return replace(rejected, status="uncertain", reason=wide, scene=scene.name)
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
