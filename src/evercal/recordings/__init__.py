"""Recordings of posed frames, read from the formats of common programs.

The readers are loaded on first use: a program that only locates images needs none of them.
"""

import importlib
from typing import TYPE_CHECKING

from evercal.recordings.frame import (
    MIN_TRAIN_FRAMES as MIN_TRAIN_FRAMES,
    Frame as Frame,
    Recording as Recording,
    posed_frames as posed_frames,
    posed_recording as posed_recording,
    stated_poses as stated_poses,
)
from evercal.recordings.images import (
    as_rgb as as_rgb,
    image_size as image_size,
    read_image as read_image,
    write_image as write_image,
)

if TYPE_CHECKING:
    from evercal.recordings.formats import generic as generic
    from evercal.recordings.load import (
        FORMATS as FORMATS,
        load_recording as load_recording,
    )
    from evercal.recordings.poses.robot_poses import (
        read_robot_poses as read_robot_poses,
    )
    from evercal.recordings.read_options import ReadOptions as ReadOptions

_LOADED_ON_USE = {
    "FORMATS": "load",
    "ReadOptions": "read_options",
    "load_recording": "load",
    "read_robot_poses": "poses.robot_poses",
    "generic": "formats.generic",
}


def __getattr__(name: str) -> object:
    """Load a reader on first use."""
    if name not in _LOADED_ON_USE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"{__name__}.{_LOADED_ON_USE[name]}")
    value: object = getattr(module, name, module)
    globals()[name] = value
    return value
