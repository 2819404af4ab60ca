"""Where the images of an episode show the camera: near poses that are tried, or anywhere."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from evercal.calibration.arm_in_view.covariance import covariance_of, in_base, parts
from evercal.calibration.arm_in_view.equations import ArmFit, TooFewPoints
from evercal.calibration.arm_in_view.fit import Fitter
from evercal.calibration.arm_in_view.result import LEAST_CONFIRMED
from evercal.calibration.arm_in_view.solve import fit_arm, priors_of
from evercal.calibration.arm_in_view.starts import Overlap
from evercal.calibration.arm_in_view.views import ArmViews
from evercal.classes import frozen_arrays
from evercal.geometry import SE3, UncertainPose
from evercal.recordings.episodes.episode import Episode
from evercal.robot.link_shapes import RobotBody
from evercal.robot.pose_errors import ArmErrors

TRIED = 3
"""Starts that are fitted, of those that overlap most with what moves."""
_SHORT_PX = (30, 15, 8)
"""How far outlines are searched in the steps of a fit, in pixels of an image of 640."""
_LAST_PX = (8, 5, 4)
_SPACING_PX = 4.0


@frozen_arrays
class ArmPose:
    """Where images of an arm show the camera."""

    base_from_camera: UncertainPose
    confirmed: float
    """Share of the arm's outline that the images show."""


class EpisodeImages:
    """Images of a camera in an episode."""

    def __init__(self, body: RobotBody, episode: Episode) -> None:
        body = replace(body, joints=episode.joints)
        self._fitter = Fitter(ArmViews.of(episode.frames, body))
        self._priors = priors_of(body, ArmErrors())

    def links(self) -> dict[str, SE3]:
        """base_from_link of the links that move, in the first image."""
        views = self._fitter.views
        found = {}
        for arm, shape in zip(views.body.arms, views.body.links, strict=True):
            if arm.joints:
                values = views.body.values_of(arm, views.values[:1])
                found[shape.link] = arm.poses(values)[0]
        return found

    def beside(self, start: SE3, reaches: Sequence[float] = _LAST_PX[:2]) -> ArmPose:
        """Fit every second image in few steps."""
        return self._fit(start, range(0, len(self._fitter.views), 2), reaches)

    def near(self, starts: Sequence[SE3]) -> ArmPose | None:
        """Fit the best of some base_from_camera; None if the images do not confirm the arm."""
        views = self._fitter.views
        overlap = Overlap(views, self._fitter.moving)
        every = np.arange(len(views))
        scores = [overlap.score(s.inverse().matrix(), every) for s in starts]
        best = None
        for i in np.argsort(scores)[::-1][:TRIED]:
            found = self.beside(starts[i], _SHORT_PX)
            if best is None or found.confirmed > best.confirmed:
                best = found
        if best is None or best.confirmed < LEAST_CONFIRMED:
            return None
        start = best.base_from_camera.pose
        return self._fit(start, range(len(views)), _LAST_PX, is_final=True)

    def anywhere(self) -> ArmPose:
        """Find the pose without a start; InputError if the images do not confirm the arm."""
        return _pose(fit_arm(self._fitter, self._priors))

    def _fit(
        self,
        start: SE3,
        images: Sequence[int],
        reaches: Sequence[float],
        is_final: bool = False,
    ) -> ArmPose:
        zoom = max(0.5, max(self._fitter.views.camera.size) / 640)
        try:
            found = self._fitter.fit(
                self._fitter.start(start.inverse()),
                self._priors,
                images,
                [zoom * reach for reach in reaches],
                _SPACING_PX,
                is_final,
            )
        except (TooFewPoints, np.linalg.LinAlgError, cv2.error):
            return ArmPose(UncertainPose.exact(start), 0.0)
        return _pose(found)


def _pose(fit: ArmFit) -> ArmPose:
    whole = covariance_of(parts(fit))
    pose = fit.estimate.camera_from_base.inverse()
    return ArmPose(UncertainPose(pose, in_base(fit, whole)), fit.confirmed)
