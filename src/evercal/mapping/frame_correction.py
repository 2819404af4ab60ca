"""The stated frame of a recording, even where it is bent.

Errors of stated poses that go together in neighbouring places (a drifting depth fusion, an arm that
sags) belong to the frame that the recording states. Bundle adjustment takes them out of the map, so
answers have to take them back: by the mean correction of the frames nearby. Whether errors go
together at all is decided by predicting every frame's correction from its neighbours' alone; noise
cannot be predicted, so it is not taken back.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evercal.geometry.se3 import SE3

Array = NDArray[np.floating]

RADII = ((0.1, 10.0), (0.2, 15.0), (0.4, 25.0))
"""Distances, metres and degrees, over which corrections may go together."""
LEAST_EXPLAINED = 0.3
"""Share of the corrections' variance that neighbours must explain."""
SHRINKAGE = 0.3
"""Weight of no correction at all, in neighbours."""


@dataclass(frozen=True, eq=False)
class FrameCorrection:
    """Corrections that bundle adjustment made to stated poses, to be taken back near them."""

    poses: SE3
    """(n,) base_from_camera of the images as adjusted, less the transform common to all."""
    correction: Array
    """(n, 6) in the camera frame, metres and radians."""
    radius: tuple[float, float]
    """Metres and radians over which corrections go together."""

    def at(self, pose: SE3) -> Array:
        """(6,) correction of a camera whose pose was told as `poses` are."""
        weight = _closeness(self.poses, pose, self.radius)
        return (weight[:, None] * self.correction).sum(0) / (weight.sum() + SHRINKAGE)


def fit_correction(poses: SE3, correction: Array) -> FrameCorrection | None:
    """What neighbouring frames say about each other's corrections; None if they say too little.

    Args:
        poses: (n,) see `FrameCorrection`.
        correction: (n, 6) of each beside the common transform, which is taken back anyway, and the
            shift in time: wrong clocks bend no frame.
    """
    scale = np.repeat([np.abs(correction[:, :3]).mean(), np.abs(correction[:, 3:]).mean()], 3)
    if (scale[[0, 3]] < [1e-4, 1e-5]).any():
        return None
    best: tuple[float, tuple[float, float]] = (LEAST_EXPLAINED, RADII[0])
    total = float(((correction / scale) ** 2).sum())
    for metres, degrees in RADII:
        radius = (metres, float(np.deg2rad(degrees)))
        weight = np.stack([_closeness(poses, poses[i], radius) for i in range(len(poses))])
        np.fill_diagonal(weight, 0)
        guess = weight @ correction / (weight.sum(1, keepdims=True) + SHRINKAGE)
        explained = 1 - float((((correction - guess) / scale) ** 2).sum()) / total
        if explained > best[0]:
            best = (explained, radius)
    if best[0] <= LEAST_EXPLAINED:
        return None
    return FrameCorrection(poses, correction, best[1])


def _closeness(poses: SE3, pose: SE3, radius: tuple[float, float]) -> Array:
    """(n,) between 0 and 1: how near poses are to one pose."""
    metres = np.linalg.norm(poses.translation_m - pose.translation_m, axis=-1)
    cosine = np.abs(poses.rotation_wxyz @ pose.rotation_wxyz).clip(0, 1)
    angle = 2 * np.arccos(cosine)
    return np.exp(-0.5 * (metres / radius[0]) ** 2 - 0.5 * (angle / radius[1]) ** 2)
