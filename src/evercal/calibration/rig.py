"""Several cameras calibrated in one map, and their poses relative to each other."""

import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import UncertainPose
from evercal.storage import write_json


class RigPair(NamedTuple):
    """Pose of the second camera in the frame of the first."""

    first: str
    second: str
    first_from_second: UncertainPose


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras that stand still in one base frame."""

    cameras: Mapping[str, Calibration]
    relative: tuple[RigPair, ...]
    """One for every two cameras."""

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        return {
            "format": "evercal-rig",
            "version": 1,
            "cameras": {name: camera.to_dict() for name, camera in self.cameras.items()},
            "relative": [
                {
                    "parent_frame": first,
                    "child_frame": second,
                    "translation_m": first_from_second.pose.translation_m.tolist(),
                    "quaternion_wxyz": first_from_second.pose.rotation_wxyz.tolist(),
                    "matrix": first_from_second.pose.matrix().tolist(),
                    "covariance": first_from_second.covariance.tolist(),
                }
                for first, second, first_from_second in self.relative
            ],
        }

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the file atomically."""
        write_json(path, self.to_dict())


def rig_of(cameras: Mapping[str, Calibration]) -> Rig:
    """Compute the relative poses of eye_to_hand cameras, as if their errors were independent."""
    scenes = {name: camera.source.get("scene") for name, camera in cameras.items()}
    if len(cameras) < 2:
        raise InputError("a rig has at least two cameras: give NAME=FOLDER for each")
    if len(set(scenes.values())) > 1:
        listed = ", ".join(f"{name} in {scene}" for name, scene in scenes.items())
        raise InputError(
            f"the cameras were located in different scenes ({listed}); a rig is in one"
        )
    pairs = []
    for first, second in itertools.combinations(cameras, 2):
        pose = cameras[first].uncertain_pose.inverse() @ cameras[second].uncertain_pose
        pairs.append(RigPair(first, second, pose))
    return Rig(cameras, tuple(pairs))
