"""evercal tells a robot where its camera is, from one ordinary image.

The names below are loaded when they are first used, so that `import evercal` costs nothing.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration as Calibration
    from evercal.calibration.calibration import read_calibration as read_calibration
    from evercal.calibration.drift import check as check
    from evercal.calibration.from_images import Images as Images
    from evercal.calibration.from_images import calibrate as calibrate
    from evercal.calibration.pose_pairs.pairs import PosePairs as PosePairs
    from evercal.calibration.pose_pairs.solve import solve as solve
    from evercal.continual.learn_into_store import learn as learn
    from evercal.continual.learn_scene import LearnOptions as LearnOptions
    from evercal.continual.learn_scene import LearnReport as LearnReport
    from evercal.continual.learn_scene import learn_scene as learn_scene
    from evercal.errors import InputError as InputError
    from evercal.evaluation.score_scenes import evaluate as evaluate
    from evercal.geometry import SE3 as SE3
    from evercal.geometry import Camera as Camera
    from evercal.localization.estimate import PoseEstimate as PoseEstimate
    from evercal.localization.localizer import Localizer as Localizer
    from evercal.recordings import Frame as Frame
    from evercal.recordings import Recording as Recording
    from evercal.recordings import load_recording as load_recording
    from evercal.recordings import read_image as read_image

__version__ = "0.1.0"

# The public names and the module that holds each. A name enters here together with its module.
_PUBLIC = {
    "Calibration": "evercal.calibration.calibration",
    "Camera": "evercal.geometry",
    "Frame": "evercal.recordings",
    "Images": "evercal.calibration.from_images",
    "InputError": "evercal.errors",
    "LearnOptions": "evercal.continual.learn_scene",
    "LearnReport": "evercal.continual.learn_scene",
    "Localizer": "evercal.localization.localizer",
    "PosePairs": "evercal.calibration.pose_pairs.pairs",
    "PoseEstimate": "evercal.localization.estimate",
    "SE3": "evercal.geometry",
    "Recording": "evercal.recordings",
    "calibrate": "evercal.calibration.from_images",
    "check": "evercal.calibration.drift",
    "evaluate": "evercal.evaluation.score_scenes",
    "learn": "evercal.continual.learn_into_store",
    "learn_scene": "evercal.continual.learn_scene",
    "load_recording": "evercal.recordings",
    "read_calibration": "evercal.calibration.calibration",
    "read_image": "evercal.recordings",
    "solve": "evercal.calibration.pose_pairs.solve",
}


def __getattr__(name: str) -> object:
    """Loads a public name on first use."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'evercal' has no attribute {name!r}")
    value = getattr(importlib.import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted({*_PUBLIC, "__version__"})
