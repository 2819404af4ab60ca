"""Stated poses of fixed cameras in recorded episodes, compared with the arm in their images."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from evercal.calibration.arm_in_view.result import LEAST_CONFIRMED
from evercal.calibration.episode_images import ArmPose, EpisodeImages
from evercal.calibration.stated_mistakes import readings
from evercal.classes import frozen, frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.recordings.episodes.episode import Episode
from evercal.recordings.poses.conventions import (
    PoseConvention,
    numbers_from_poses,
    pose_convention,
)
from evercal.typing import Floats, Pair

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
    stated: Floats
    """Pose in the data set."""
    verdict: Literal["right", "wrong", "unknown"]
    """Whether the stated pose fits the images; unknown if they do not decide it."""
    reason: str
    mistake: str = ""
    """What is wrong, if it is a usual mistake."""
    corrected: Floats = ()
    """The pose in the notation of the data set: as stated where that is right, else the estimated
    one; empty if there is none."""
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

    look: Callable[[Episode], EpisodeImages]
    convention: PoseConvention | None = None
    """Of the stated poses; if omitted, the usual one for so many numbers."""
    of_all: SE3 | None = None
    """base_from_camera of cameras without a stated pose."""
    agreement: Pair = (20.0, 1.0)
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

    def convention_of(self, numbers: Floats) -> PoseConvention:
        """The convention of stated numbers."""
        usual = _USUAL.get(len(numbers), "matrix")
        return self.convention or pose_convention(usual)

    def _audited(self, episode: Episode, known: Sequence[SE3]) -> Audited:
        if episode.problem:
            raise InputError(episode.problem)
        blank = self.failed(0, (episode, known), "states no pose")
        images = self.look(episode)
        possible = self._readings(episode, images, blank.stated)
        stated = possible.get("")
        beside = images.beside(stated) if stated else None
        if beside and beside.confirmed >= LEAST_CONFIRMED:
            result = self._compared(blank, possible, beside)
            if result.verdict == "right":
                return result
        found = images.near([*known, *possible.values()]) or images.anywhere()
        result = self._compared(blank, possible, found)
        if not beside or result.verdict != "wrong":
            return result
        same = self._agree(beside.base_from_camera.pose, found.base_from_camera.pose)
        if same or found.confirmed > MORE_CONFIRMED * beside.confirmed:
            return result
        reason = f"{result.reason}, which show hardly less of the arm at the stated one"
        return replace(result, verdict="unknown", mistake="", reason=reason)

    def _compared(
        self, result: Audited, possible: dict[str, SE3], found: ArmPose
    ) -> Audited:
        """The result with the pose that images show."""
        estimate = found.base_from_camera
        result = replace(
            result,
            corrected=self._noted(estimate.pose, result),
            sigma_mm=estimate.sigma_mm,
            sigma_deg=estimate.sigma_deg,
            confirmed=found.confirmed,
        )
        stated = possible.get("")
        if stated:
            mm, degrees = pose_distance_mm_deg(stated, estimate.pose)
            reason = f"stated pose is {mm:.0f} mm and {degrees:.1f} deg from the images"
            result = replace(
                result, reason=reason, translation_mm=mm, rotation_deg=degrees
            )
            if self._agree(stated, estimate.pose):
                return replace(result, verdict="right", corrected=result.stated)
            if estimate.squared_mahalanobis(stated) < LARGEST_SQUARE:
                return result
            result = replace(result, verdict="wrong")
        for words, pose in possible.items():
            if words and self._agree(pose, estimate.pose, _NAMING):
                corrected = self._noted(pose, result)
                return replace(
                    result, verdict="wrong", mistake=words, corrected=corrected
                )
        return result

    def _noted(self, pose: SE3, result: Audited) -> Floats:
        convention = self.convention_of(result.stated)
        return tuple(numbers_from_poses(pose, convention).tolist())

    def _readings(
        self, episode: Episode, images: EpisodeImages, numbers: Floats
    ) -> dict[str, SE3]:
        """What the stated numbers may mean, by mistake; as they are stated without one."""
        if self.of_all and not numbers:
            return {"": self.of_all}
        found = readings(numbers, self.convention_of(numbers))
        if "" in found:
            for link, base_from_link in images.links().items():
                found[f"relative to {link}"] = base_from_link @ found[""]
        for camera, other in episode.stated.items():
            pose = readings(other, self.convention_of(other)).get("")
            if pose and camera != episode.camera:
                found[f"that of {camera}"] = pose
        return found

    def _agree(self, a: SE3, b: SE3, times: float = 1.0) -> bool:
        difference = np.array(pose_distance_mm_deg(a, b))
        return bool((difference <= times * np.array(self.agreement)).all())
