"""Everything that yields posed frames: one format, one file, one `load(root) -> Scene`."""

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from evercal.datasets import generic, seven_scenes, twelve_scenes
from evercal.datasets.frame import MIN_TRAIN_FRAMES as MIN_TRAIN_FRAMES
from evercal.datasets.frame import Frame as Frame
from evercal.datasets.frame import Scene as Scene
from evercal.datasets.frame import known_poses as known_poses
from evercal.datasets.frame import posed as posed
from evercal.datasets.frame import posed_scene as posed_scene
from evercal.datasets.images import image_size as image_size
from evercal.datasets.images import read_image as read_image
from evercal.datasets.images import write_image as write_image
from evercal.datasets.robot_poses import RobotPoses as RobotPoses
from evercal.datasets.robot_poses import read_robot_poses as read_robot_poses
from evercal.datasets.sfm_poses import with_sfm_poses as with_sfm_poses
from evercal.errors import InputError


@dataclass(frozen=True)
class Format:
    """How one dataset format is recognised and read."""

    detect: Callable[[Path], bool]
    """Whether a folder looks like this format."""
    load: Callable[[Path], Scene]
    """Reads it."""


FORMATS: dict[str, Format] = {
    "generic": Format(generic.detect, generic.load),
    "7scenes": Format(seven_scenes.detect, seven_scenes.load),
    "12scenes": Format(twelve_scenes.detect, twelve_scenes.load),
}


def load_scene(
    path: str | os.PathLike[str], format: str | None = None, name: str | None = None
) -> Scene:
    """Reads a recorded scene.

    Args:
        path: The scene's folder.
        format: One of `FORMATS`; recognised from the files when left out.
        name: What the scene is called; else the name in its file or that of its folder.

    Raises:
        InputError: The folder is missing, of no known format, or broken.
    """
    root = Path(path)
    if format is not None and format not in FORMATS:
        raise InputError(f"format {format!r} is not known; use one of {', '.join(FORMATS)}")
    if not root.is_dir():
        what = "a file, not a folder" if root.exists() else "no such folder"
        raise InputError(f"{root}: {what}; give the folder of a recorded scene")
    if format is None:
        format = next((key for key, entry in FORMATS.items() if entry.detect(root)), None)
    if format is None:
        raise InputError(
            f"{root}: no known scene format; expected scene.json (generic), TrainSplit.txt,"
            f" TestSplit.txt and seq-XX folders (7scenes), or info.txt and data (12scenes)"
        )
    scene = FORMATS[format].load(root)
    return scene if name is None else dataclasses.replace(scene, name=name)
