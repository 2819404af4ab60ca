"""evercal estimates the pose of a camera in the robot's base frame from one ordinary image.

    Map               learned scenes: learn, localize, track, calibrate, check, evaluate.
    PoseEstimate      the answer for one image: pose, covariance, status, reason.
    Calibration       pose of a camera with its sources of error, checks and verdict.
    Shift             motion of a camera since its calibration.
    LearnReport       what learning a scene did.
    Scores            accuracy on recordings with known poses.

    SE3               one rigid transform, or an array of them.
    UncertainPose     a rigid transform with a covariance.
    Camera            intrinsics of one camera at one image size.
    Frame             one image with its camera and poses.
    FrameNames        names of the frames of base, gripper and camera.
    Recording         frames of one place in recorded order.
    PosePairs         poses of the gripper and of a board in the camera.

    load_recording    read a folder or a bag.
    read_image        read an image file as RGB.
    read_calibration  read a calibration file.
    solve             calibrate a camera from pose pairs.
    next_views        the gripper poses that would determine a camera best.

    LocalizeOptions   effort and thresholds of localization.
    MapOptions        sizes and priors of a map.
    ReadOptions       how to read a recording.
    Client            a map that `evercal serve` serves.
    InputError        misuse or bad input; its message says what to do.

They are loaded on first use, so that `import evercal` is fast.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evercal.calibration.calibration import (
        Calibration as Calibration,
        read_calibration as read_calibration,
    )
    from evercal.calibration.drift import Shift as Shift
    from evercal.calibration.from_map.next_views import next_views as next_views
    from evercal.calibration.pose_pairs.pairs import PosePairs as PosePairs
    from evercal.calibration.pose_pairs.solve import solve as solve
    from evercal.errors import InputError as InputError
    from evercal.evaluation import Scores as Scores
    from evercal.geometry import (
        SE3 as SE3,
        Camera as Camera,
        UncertainPose as UncertainPose,
    )
    from evercal.learning.report import LearnReport as LearnReport
    from evercal.localization.estimate import PoseEstimate as PoseEstimate
    from evercal.localization.options import LocalizeOptions as LocalizeOptions
    from evercal.map import Map as Map
    from evercal.mapping.build import MapOptions as MapOptions
    from evercal.recordings import (
        Frame as Frame,
        ReadOptions as ReadOptions,
        Recording as Recording,
        load_recording as load_recording,
        read_image as read_image,
    )
    from evercal.robot.frame_names import FrameNames as FrameNames
    from evercal.service.client import Client as Client

__version__ = "0.2.0"

_PUBLIC = {
    "Calibration": "evercal.calibration.calibration",
    "Camera": "evercal.geometry",
    "Client": "evercal.service.client",
    "Frame": "evercal.recordings",
    "FrameNames": "evercal.robot.frame_names",
    "InputError": "evercal.errors",
    "LearnReport": "evercal.learning.report",
    "LocalizeOptions": "evercal.localization.options",
    "Map": "evercal.map",
    "MapOptions": "evercal.mapping.build",
    "PoseEstimate": "evercal.localization.estimate",
    "PosePairs": "evercal.calibration.pose_pairs.pairs",
    "ReadOptions": "evercal.recordings",
    "Recording": "evercal.recordings",
    "SE3": "evercal.geometry",
    "Scores": "evercal.evaluation",
    "Shift": "evercal.calibration.drift",
    "UncertainPose": "evercal.geometry",
    "load_recording": "evercal.recordings",
    "next_views": "evercal.calibration.from_map.next_views",
    "read_calibration": "evercal.calibration.calibration",
    "read_image": "evercal.recordings",
    "solve": "evercal.calibration.pose_pairs.solve",
}
"""Public names and the modules that define them."""


def __getattr__(name: str) -> object:
    """Load a public name on first use."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'evercal' has no attribute {name!r}")
    value = getattr(importlib.import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted({*_PUBLIC, "__version__"})
