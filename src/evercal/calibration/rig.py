"""Several cameras calibrated in one map, and their poses relative to each other."""

import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3, axis_deviation
from evercal.storage import write_json


@dataclass(frozen=True, eq=False)
class RigPair:
    """One camera in the frame of another."""

    first: str
    """Name of the camera whose frame it is."""
    second: str
    """Name of the camera that is in it."""
    first_from_second: SE3
    """Single."""
    covariance: NDArray[np.float64]
    """(6, 6) of translation in the first camera's frame and rotation about the second's axes."""

    @property
    def sigma_mm(self) -> float:
        """One standard deviation per axis."""
        return axis_deviation(self.covariance)[0]

    @property
    def sigma_deg(self) -> float:
        """The same for the rotation."""
        return axis_deviation(self.covariance)[1]


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras that stand still in one base frame."""

    cameras: Mapping[str, Calibration]
    """By name."""
    relative: tuple[RigPair, ...]
    """Of every two of them."""

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "format": "evercal-rig",
            "version": 1,
            "cameras": {name: found.to_dict() for name, found in self.cameras.items()},
            "relative": [
                {
                    "parent_frame": pair.first,
                    "child_frame": pair.second,
                    "translation_m": pair.first_from_second.translation_m.tolist(),
                    "quaternion_wxyz": pair.first_from_second.rotation_wxyz.tolist(),
                    "matrix": pair.first_from_second.matrix().tolist(),
                    "covariance": pair.covariance.tolist(),
                }
                for pair in self.relative
            ],
        }

    def write(self, path: str | os.PathLike[str]) -> None:
        """Creates or replaces the file, whole or not at all."""
        write_json(path, self.to_dict())


def rig_of(cameras: Mapping[str, Calibration]) -> Rig:
    """Cameras with their poses relative to each other.

    Args:
        cameras: by name, all eye_to_hand and in one scene.

    Raises:
        InputError: fewer than two, or cameras in different scenes.
    """
    scenes = {name: found.source.get("scene") for name, found in cameras.items()}
    if len(cameras) < 2:
        raise InputError("a rig has at least two cameras: give NAME=FOLDER for each")
    if len(set(scenes.values())) > 1:
        listed = ", ".join(f"{name} in {scene}" for name, scene in scenes.items())
        raise InputError(
            f"the cameras were located in different scenes ({listed}); a rig is in one"
        )
    return Rig(cameras, tuple(_pair(a, b, cameras) for a, b in itertools.combinations(cameras, 2)))


def _pair(first: str, second: str, cameras: Mapping[str, Calibration]) -> RigPair:
    """Errors of both are taken as independent, which overestimates them for common landmarks."""
    a, b = cameras[first].uncertain_pose, cameras[second].uncertain_pose
    first_from_second = a.inverse() @ b
    return RigPair(first, second, first_from_second.pose, first_from_second.covariance)
