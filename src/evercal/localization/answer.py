"""Answers: an accepted pose in the base frame, or the reason for rejecting it."""

import math
from dataclasses import replace

import numpy as np

from evercal.geometry import SE3, UncertainPose, pose_distance, pose_distance_mm_deg
from evercal.localization import acceptance
from evercal.localization.estimate import CovarianceTerm, PoseEstimate
from evercal.localization.hypothesis import Aligned, Hypothesis, accepted
from evercal.localization.lack_of_fit import WARPED, LackOfFit, lack_of_fit, unlikely
from evercal.localization.other_bases import InBase
from evercal.mapping.scene_map import SceneMap
from evercal.typing import Array, Pair


def rejection(
    hypothesis: Hypothesis | None, scene: SceneMap, mirrored: float = 0.0
) -> str:
    """Why a pose is not accepted; `mirrored` is the support of the mirror image."""
    required = acceptance.required_support()
    if mirrored > required:
        return _mirrored_reason(hypothesis.support if hypothesis else 0.0, mirrored)
    if not hypothesis:
        return "fewer than 6 inliers"
    share = f"{100 * hypothesis.inlier_ratio:.0f} %"
    return (
        f"{hypothesis.inliers} inliers, {share} of the landmarks of {scene.name} that should be"
        f" visible: support {hypothesis.support:.1f}, {required:.1f} is required"
    )


def widening(hypothesis: Hypothesis) -> float:
    """Factor on the covariance of an accepted pose."""
    return max(1.0, acceptance.FULL_SUPPORT / hypothesis.support)


def differ(hypothesis: Hypothesis, other: SE3) -> bool:
    """Whether another pose, map_from_camera, is outside the uncertainty of an accepted one."""
    metres, radians = pose_distance(hypothesis.pose.pose, other)
    far = metres > acceptance.APART_M or radians > acceptance.APART_RAD
    squares = hypothesis.pose.squared_mahalanobis(other) / widening(hypothesis)
    return bool(far and squares > acceptance.APART_SIGMAS**2)


def in_base(
    hypothesis: Hypothesis, scene: SceneMap, misfit: LackOfFit | None = None
) -> tuple[UncertainPose, tuple[CovarianceTerm, ...]]:
    """The answer in the base frame, and the shares of its covariance."""
    frame = scene.frame
    factor = widening(hypothesis)
    pose = hypothesis.pose
    covariance = factor * pose.covariance
    if misfit:
        covariance = covariance + misfit.covariance
    wide = UncertainPose(pose.pose, covariance)
    estimate = frame.to_base(wide)
    if not isinstance(hypothesis, Aligned):
        return estimate, ()
    lens = _moved(frame.slope, factor * hypothesis.by_intrinsics)
    view = _moved(frame.slope, wide.covariance) - lens
    poses = _moved(frame.slope, _diagonal(frame.pose_sigma))
    stated = _moved(frame.slope, _diagonal(frame.frame_sigma))
    base = estimate.covariance - view - lens - poses - stated
    return estimate, (
        CovarianceTerm("view", view),
        CovarianceTerm("lens", lens),
        CovarianceTerm("map", poses),
        CovarianceTerm("stated poses", stated),
        CovarianceTerm("base frame", base),
    )


def _moved(slope: Array, covariance: Array) -> Array:
    return slope @ covariance @ slope.T


def _diagonal(sigma: Pair) -> Array:
    """(6, 6) covariance of standard deviations per axis, of translation and rotation."""
    return np.diag(np.repeat(np.square(sigma), 3))


def answer(
    best: Hypothesis | None,
    scene: SceneMap,
    size: tuple[int, ...],
    milliseconds: float,
    rival: InBase | None = None,
    mirrored: float = 0.0,
) -> PoseEstimate:
    """The answer for a pose in the map's frame, or two if another one fits as well.

    `size` are height and width of the image; `mirrored` is the support of its mirror image.
    """
    if not best:
        return PoseEstimate.failed(rejection(None, scene, mirrored), milliseconds)
    rejected = PoseEstimate(
        status="unknown_scene",
        reason="",
        scene=None,
        base_from_camera=None,
        covariance=None,
        inliers=best.inliers,
        inlier_ratio=best.inlier_ratio,
        milliseconds=milliseconds,
        support=best.support,
    )
    if not accepted(best):
        return replace(rejected, reason=rejection(best, scene, mirrored))
    misfit = _misfit(best)
    estimate, terms = in_base(best, scene, misfit)
    rejected = replace(rejected, parent_frame=scene.parent_frame, base=scene.base)
    if rival:
        return replace(
            rejected,
            status="ambiguous",
            reason=_rival_reason(estimate.pose, rival, scene),
            scene=scene.name,
            alternatives=(estimate.pose, rival.pose),
            alternatives_in=(scene.name, rival.scene.name),
        )
    position_m = estimate.sigma_mm / 1000
    reason = _useless(best, misfit, position_m, mirrored, scene)
    if reason:
        return replace(rejected, status="uncertain", reason=reason, scene=scene.name)
    camera = None
    if isinstance(best, Aligned):
        height, width = size
        camera = best.camera.resized(width, height)
    return replace(
        rejected,
        status="ok",
        scene=scene.name,
        base_from_camera=estimate.pose,
        covariance=estimate.covariance,
        terms=terms,
        pixels=best.pixels,
        points_m=scene.frame.points_to_base(best.points_m),
        camera=camera,
    )


def _rival_reason(pose: SE3, other: InBase, scene: SceneMap) -> str:
    mm, deg = pose_distance_mm_deg(pose, other.pose)
    away = f"{deg:.1f} deg away"
    if scene.metric:
        away = f"{mm:.0f} mm, {away}"
    if other.scene is not scene:
        return (
            f"{scene.name} and {other.scene.name} map this place in two bases, the pose"
            f" in the second is {away}; name the scene with `scene`"
        )
    return f"ambiguous: a second pose {away} fits equally well"


def _misfit(best: Hypothesis) -> LackOfFit | None:
    """Lack of fit of an aligned pose, if it is significant."""
    if not isinstance(best, Aligned):
        return None
    pose = best.pose.pose
    return lack_of_fit(best.observed, best.camera, pose, best.change)


def _useless(
    best: Hypothesis,
    misfit: LackOfFit | None,
    position: float,
    mirrored: float,
    scene: SceneMap,
) -> str:
    """Why an accepted pose is of no use; empty where it is of use."""
    if mirrored > best.support:
        return _mirrored_reason(best.support, mirrored)
    if isinstance(best, Aligned):
        camera = best.camera
        less = best.support - unlikely(camera, best.change)
        if less < acceptance.required_support():
            return (
                f"it needs a principal point at ({camera.cx:.0f}, {camera.cy:.0f}) of"
                f" {camera.width}x{camera.height} px: give the whole image as the camera took it"
            )
    if misfit and misfit.size * math.sqrt(widening(best)) > WARPED:
        return misfit.reason
    if scene.at_room_scale(position) <= acceptance.USELESS_M:
        return ""
    reason = _uncertain_reason(position, scene)
    if misfit:
        return f"{reason}: {misfit.reason}"
    return reason


def _mirrored_reason(support: float, mirrored: float) -> str:
    return (
        f"the image is mirrored: its mirror image has support {mirrored:.1f}, the image"
        f" {support:.1f}; switch the mirror of the camera off"
    )


def _uncertain_reason(position: float, scene: SceneMap) -> str:
    sigma = f"{position:.3g}"
    if scene.metric:
        sigma = f"{1000 * scene.at_room_scale(position):.0f} mm"
    return f"its position is uncertain by {sigma} per axis"
