"""Stated poses of fixed cameras in recorded episodes, compared with the arm in their images."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from evercal.calibration.arm_in_view.result import LEAST_CONFIRMED
from evercal.calibration.episode_images import ArmPose, EpisodeImages
from evercal.calibration.stated_mistakes import Reading, readings
from evercal.classes import frozen, frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.recordings.episodes.episode import Episode, Numbers
from evercal.recordings.poses.conventions import (
    PoseConvention,
    numbers_from_poses,
    pose_convention,
)
from evercal.robot.robot_model import RobotModel

LARGEST_SQUARE = 22.5
"""Squared Mahalanobis distance that one of 1,000 right poses exceeds (chi-squared, 6 degrees of
freedom)."""
MORE_CONFIRMED = 1.25
"""Ratio of the shares of the outline that images show at another pose and beside the stated one,
above which that is wrong."""
_NAMING = 2.0
"""Tolerance of poses without a mistake, in that of right poses: they are far from each other."""
_USUAL = {6: "rpy", 7: "xyzw"}
"""Conventions by count of numbers; else a matrix."""


@frozen
class Audited:
    """Result for a camera in an episode."""

    episode: str
    camera: str
    stated: Numbers
    """Pose in the data set."""
    verdict: Literal["right", "wrong", "unknown"]
    """Whether the stated pose fits the images; unknown if they do not decide it."""
    reason: str
    mistake: str = ""
    """What is wrong, if it is a usual mistake."""
    corrected: Numbers = ()
    """The estimated pose in the notation of the data set; empty if there is none."""
    translation_mm: float | None = None
    """Distance of the stated pose from the estimated one."""
    rotation_deg: float | None = None
    sigma_mm: float | None = None
    """Standard deviation of the estimated pose."""
    sigma_deg: float | None = None
    confirmed: float | None = None
    """Share of the arm's outline that the images show."""
    seconds: float = 0.0
    """CPU time."""


Source = tuple[Episode, Sequence[SE3]]
"""An episode, and poses of its camera in other episodes."""


@frozen_arrays
class ArmAudit:
    """How episodes are audited; a task of `learning.many`."""

    model: RobotModel
    look: Callable[[Episode], EpisodeImages]
    convention: str | None = None
    """Of the stated poses; if omitted, the usual one for so many numbers."""
    of_all: SE3 | None = None
    """base_from_camera of cameras without a stated pose."""
    agreement: tuple[float, float] = (20.0, 1.0)
    """Largest difference that still agrees, millimetres and degrees."""

    def done(self, number: int, source: Source) -> Audited:
        """Audit an episode."""
        start = time.process_time()
        try:
            result = self._audited(*source)
        except InputError as error:
            result = self.failed(number, source, str(error))
        return replace(result, seconds=time.process_time() - start)

    def failed(self, number: int, source: Source, error: str) -> Audited:
        """The result for an episode that cannot be audited."""
        episode = source[0]
        stated = episode.stated.get(episode.camera, ())
        return Audited(episode.name, episode.camera, stated, "unknown", error)

    def convention_of(self, numbers: Numbers) -> PoseConvention:
        """The convention of stated numbers."""
        usual = _USUAL.get(len(numbers), "matrix")
        return pose_convention(self.convention or usual)

    def _audited(self, episode: Episode, known: Sequence[SE3]) -> Audited:
        if episode.problem:
            raise InputError(episode.problem)
        result = self.failed(0, (episode, known), "states no pose")
        possible = [*self._readings(episode, result.stated)]
        images = self.look(episode)
        beside = None
        if possible and not possible[0][0]:
            beside = images.beside(possible[0][1])
            if beside.confirmed >= LEAST_CONFIRMED:
                result = self._compared(result, possible, beside)
                if result.verdict == "right":
                    return result
        starts = [pose for words, pose in possible if len(words) <= 1]
        found = images.near([*known, *starts]) or images.anywhere()
        result = self._compared(result, possible, found)
        if beside is None or result.verdict != "wrong":
            return result
        same = self._agree(beside.base_from_camera.pose, found.base_from_camera.pose)
        if same or found.confirmed > MORE_CONFIRMED * beside.confirmed:
            return result
        reason = f"{result.reason}, which show hardly less of the arm at the stated one"
        return replace(result, verdict="unknown", mistake="", reason=reason)

    def _compared(
        self, result: Audited, possible: Sequence[Reading], found: ArmPose
    ) -> Audited:
        """The result with the pose that images show."""
        estimate = found.base_from_camera
        convention = self.convention_of(result.stated)

        def noted(pose: SE3) -> Numbers:
            return tuple(numbers_from_poses(pose, convention).tolist())

        result = replace(
            result,
            corrected=noted(estimate.pose),
            sigma_mm=estimate.sigma_mm,
            sigma_deg=estimate.sigma_deg,
            confirmed=found.confirmed,
        )
        if not possible:
            return result
        words, stated = possible[0]
        result = replace(
            result, verdict="wrong", reason=f"no pose as {convention.name}"
        )
        if not words:
            mm, degrees = pose_distance_mm_deg(stated, estimate.pose)
            reason = f"stated pose is {mm:.0f} mm and {degrees:.1f} deg from the images"
            result = replace(
                result, reason=reason, translation_mm=mm, rotation_deg=degrees
            )
            if self._agree(stated, estimate.pose):
                return replace(result, verdict="right")
            if estimate.squared_mahalanobis(stated) < LARGEST_SQUARE:
                return replace(result, verdict="unknown")
        for words, pose in possible:
            if words and self._agree(pose, estimate.pose, _NAMING):
                mistake = ", ".join(words)
                return replace(result, mistake=mistake, corrected=noted(pose))
        return result

    def _readings(self, episode: Episode, numbers: Numbers) -> Iterator[Reading]:
        """What the stated numbers may mean; first as they are stated, if that is a pose."""
        if self.of_all is not None and not numbers:
            yield (), self.of_all
        for words, pose in readings(numbers, self.convention_of(numbers)):
            yield words, pose
            if not words:
                for link, base_from_link in self._links(episode):
                    yield (f"relative to {link}",), base_from_link @ pose
        for camera, other in episode.stated.items():
            for words, pose in readings(other, self.convention_of(other)):
                if not words and camera != episode.camera:
                    yield (f"that of {camera}",), pose

    def _links(self, episode: Episode) -> Iterator[tuple[str, SE3]]:
        """base_from_link of the links that move, in the first image."""
        values = episode.frames[0].joints_rad or ()
        known = dict(zip(episode.joints, values, strict=True))
        for link in self.model.links:
            arm = self.model.arm(self.model.base_link, link)
            if arm.joints and known.keys() >= {*arm.joints}:
                row = [known[name] for name in arm.joints]
                yield link, arm.poses(np.array([row]))[0]

    def _agree(self, a: SE3, b: SE3, times: float = 1.0) -> bool:
        difference = np.array(pose_distance_mm_deg(a, b))
        return bool((difference <= times * np.array(self.agreement)).all())
