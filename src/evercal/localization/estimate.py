"""`PoseEstimate`: the answer for one image."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from evercal.choices import Status
from evercal.classes import frozen_arrays, html_table
from evercal.geometry import SE3, Camera, UncertainPose
from evercal.typing import Strings

Cause = Literal["view", "lens", "map", "stated poses", "base frame"]


@frozen_arrays
class CovarianceTerm:
    """The share of one cause in the covariance of a pose."""

    name: Cause
    """`view`: landmarks of this image. `lens`: its intrinsics. `map`: poses of keyframes.
    `stated poses`: errors that neighbouring stated poses share. `base frame`: a motion of the base
    frame that all answers share."""
    covariance: np.ndarray
    """(6, 6), see `PoseEstimate.covariance`."""


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The answer for one image; failure is a value, not an exception."""

    status: Status
    """`uncertain`: the scene is known, but the pose is too uncertain to be useful, or the image is
    not as a camera took it. `ambiguous`: two poses explain the image, in one base or in several,
    see `alternatives`.
    `unknown_scene`: no pose has enough support. `failed`: no pose."""
    reason: str
    """Why the status is not `ok`; empty otherwise."""
    scene: str | None
    base_from_camera: SE3 | None
    """Camera pose in the scene's base frame, metres, OpenCV axes."""
    covariance: np.ndarray | None
    """(6, 6) of (translation in the base frame, metres; rotation about camera axes, radians)."""
    inliers: int
    """Landmarks that agree with the pose."""
    inlier_ratio: float
    """Inliers as a share of the landmarks that should be visible."""
    milliseconds: float
    """Time from image to answer, without decoding."""
    pixels: np.ndarray | None = None
    """(n, 2) inliers in pixels of the image at working size, for overlays."""
    points_m: np.ndarray | None = None
    """(n, 3) their scene points in the base frame, metres."""
    camera: Camera | None = None
    """Intrinsics that the pose holds for, at the size of the image; None without alignment."""
    terms: tuple[CovarianceTerm, ...] = ()
    """Shares that sum to the covariance; empty without alignment."""
    alternatives: tuple[SE3, ...] = ()
    """The poses base_from_camera of an ambiguous image, the stronger one first."""
    alternatives_in: Strings = ()
    """Their scenes: two where scenes map one place in several bases."""
    base: str = ""
    """Name of the base; empty where the scene has none."""
    omitted: Strings = ()
    """Steps that a time for the frame left out, see `TrackOptions.at_most_ms`."""
    parent_frame: str = "base"
    """gripper in the map of a thing that the gripper holds: the pose is then
    gripper_from_camera."""
    support: float = 0.0
    """-log10 of the probability of as many inliers at a wrong pose."""

    @classmethod
    def failed(cls, reason: str, milliseconds: float = 0.0) -> "PoseEstimate":
        """The answer without any pose."""
        return cls(
            "failed",
            reason,
            None,
            None,
            None,
            0,
            0.0,
            milliseconds,
        )

    @property
    def scene_in_words(self) -> str:
        """The scene and its base."""
        if self.base:
            return f"{self.scene}, base {self.base}"
        return str(self.scene)

    @property
    def uncertain_pose(self) -> UncertainPose | None:
        """Pose with covariance; None if there is no pose."""
        if not self.base_from_camera or self.covariance is None:
            return None
        return UncertainPose(self.base_from_camera, self.covariance)

    def __repr__(self) -> str:
        words = [f"{name} {value}" for name, value in self._in_words().items()]
        return f"PoseEstimate({', '.join(words)})"

    def _repr_html_(self) -> str:
        return html_table("PoseEstimate", self._in_words())

    def _in_words(self) -> dict[str, str]:
        words = {"status": self.status, "scene": self.scene or "none"}
        pose = self.uncertain_pose
        if pose:
            x, y, z = pose.pose.translation_m
            position = f"({x:.4f}, {y:.4f}, {z:.4f})"
            words["position"] = f"{position} in {self.parent_frame}"
            variance = np.trace(pose.covariance[:3, :3]) / 3
            sigma = f"{np.sqrt(variance):.5f}"
            words["standard deviation"] = f"{sigma}, {pose.sigma_deg:.3f} deg"
        if self.reason:
            words["reason"] = self.reason
        return words | {"inliers": str(self.inliers)}
