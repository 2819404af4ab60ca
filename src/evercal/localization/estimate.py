"""What localization answers."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from evercal.geometry.se3 import SE3


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The answer for one image; failure is a value, not an exception."""

    status: Literal["ok", "unknown_scene", "failed"]
    """`unknown_scene`: a pose was found but too little agrees with it. `failed`: none was found, or
    a network gave one outside the cell of its scene."""
    reason: str
    """Why the status is not `ok`; empty otherwise."""
    scene: str | None
    """Name of the scene that the pose lies in."""
    base_from_camera: SE3 | None
    """Camera pose in that scene's base frame, metres, OpenCV axes."""
    covariance: np.ndarray | None
    """(6, 6) of (translation in the base frame, metres; rotation about camera axes, radians)."""
    inliers: int
    """Landmarks that were found where the pose puts them; without a map, patches that agree."""
    inlier_ratio: float
    """The same as a share of those that should be visible; without a map, of all patches."""
    milliseconds: float
    """Time from image to answer, decoding not included."""
    pixels: np.ndarray | None = None
    """(n, 2) what agrees, in pixels of the working image, for overlays."""
    points_m: np.ndarray | None = None
    """(n, 3) their scene points in the base frame, metres."""
    support: float = 0.0
    """What the scene's threshold is compared with, see `localization.acceptance`."""
