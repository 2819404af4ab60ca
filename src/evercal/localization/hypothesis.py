"""Hypotheses of a pose in one scene: by PnP, and by alignment of landmarks."""

import math
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from evercal.classes import frozen_arrays
from evercal.geometry import SE3, Camera, UncertainPose, norms
from evercal.localization import acceptance
from evercal.localization.pose_refinement import Observed
from evercal.localization.query import Candidate
from evercal.typing import Array


class Matches(NamedTuple):
    """2D-3D matches of an image in one scene."""

    pixels: Array
    """(m, 2) in the ideal pinhole, at the encoder's working size."""
    points_m: Array
    """(m, 3) in the scene's frame."""

    def beside(self, camera: Camera, pose: SE3, px: float) -> "Matches":
        """Matches whose reprojection error at a pose map_from_camera is above `px`."""
        projected = camera.pinhole.project(pose.inverse().apply(self.points_m))
        errors_px = norms(projected - self.pixels)
        outliers = ~(errors_px < px)  # points behind the camera have no projection
        return Matches(self.pixels[outliers], self.points_m[outliers])


NO_MATCHES = Matches(np.zeros((0, 2)), np.zeros((0, 3)))
"""Of a pose that did not start from matches."""


@frozen_arrays
class Hypothesis:
    """A pose of the image, assuming that it shows one scene."""

    scene: int
    pose: UncertainPose
    """map_from_camera."""
    pixels: Array
    """(n, 2) inliers, pixels at the encoder's working size."""
    points_m: Array
    """(n, 3) their points in the map's frame."""
    expected: int
    """Landmarks that should be visible and were searched; by PnP, the number of matches."""
    pnp_inliers: int
    """Matches that agree with the pose before alignment."""

    @property
    def inliers(self) -> int:
        """Landmarks, or matches, that agree with the pose."""
        return len(self.pixels)

    @property
    def inlier_ratio(self) -> float:
        """Inliers as a share of the landmarks that should be visible."""
        return self.inliers / max(self.expected, 1)

    @cached_property
    def support(self) -> float:
        """Support of the pose, see `acceptance`."""
        return acceptance.support(self.inliers, self.expected)


@frozen_arrays
class Rough(Hypothesis):
    """A pose by PnP."""

    @classmethod
    def unconfirmed(cls, scene: int, map_from_camera: SE3, pnp_inliers: int) -> Self:
        """A pose whose alignment failed: it has no inliers among the landmarks."""
        pose = UncertainPose.exact(map_from_camera)
        return cls(scene, pose, *NO_MATCHES, expected=0, pnp_inliers=pnp_inliers)


@frozen_arrays
class Aligned(Hypothesis):
    """A pose by alignment of landmarks."""

    candidate: Candidate
    """Keyframes whose landmarks were aligned."""
    camera: Camera
    """Estimated intrinsics at the size of `Query.grey`."""
    change: Array
    """(5,) change of the intrinsics, see `Camera.changed`."""
    by_intrinsics: Array
    """(6, 6) share of the pose's covariance that is due to the intrinsics."""
    observed: Observed
    """Matched landmarks, in pixels of `Query.grey`."""
    measured: Array
    """(5, 5) covariance of the change as the image alone measures it."""
    matches: Matches = NO_MATCHES
    """All matches of the PnP pose."""


def order(hypothesis: Hypothesis | None) -> tuple[float, int]:
    """Poses are ordered by their support, and by PnP inliers where they have none."""
    if not hypothesis:
        return 0.0, 0
    return hypothesis.support, hypothesis.pnp_inliers


def accepted(hypothesis: Hypothesis | None, times: float = 1.0) -> bool:
    """Whether there is a pose with `times` the support that is required."""
    if not hypothesis:
        return False
    return hypothesis.support >= -times * math.log10(acceptance.FALSE_ACCEPTS)
