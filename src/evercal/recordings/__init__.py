"""Everything that yields posed frames: one format, one file, one `load(root) -> Recording`."""

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from evercal.errors import InputError
from evercal.recordings.formats import (
    colmap,
    generic,
    lerobot,
    nerfstudio,
    ros_bag,
    seven_scenes,
    twelve_scenes,
    wrist,
)
from evercal.recordings.frame import MIN_TRAIN_FRAMES as MIN_TRAIN_FRAMES
from evercal.recordings.frame import Frame as Frame
from evercal.recordings.frame import Recording as Recording
from evercal.recordings.frame import posed_frames as posed_frames
from evercal.recordings.frame import posed_recording as posed_recording
from evercal.recordings.frame import stated_poses as stated_poses
from evercal.recordings.images import image_size as image_size
from evercal.recordings.images import read_image as read_image
from evercal.recordings.images import write_image as write_image
from evercal.recordings.poses.robot_poses import RobotPoses as RobotPoses
from evercal.recordings.poses.robot_poses import read_robot_poses as read_robot_poses
from evercal.recordings.poses.sfm_poses import with_sfm_poses as with_sfm_poses
from evercal.recordings.read_options import ReadOptions as ReadOptions
from evercal.recordings.read_options import flag


@dataclass(frozen=True)
class Format:
    """How one dataset format is recognised and read."""

    detect: Callable[[Path], bool]
    """Whether a folder or file looks like this format."""
    load: Callable[[Path, ReadOptions], Recording]
    """Reads it."""
    shows: str
    """What it is recognised by, for people."""
    uses: tuple[str, ...] = ()
    """The fields of `ReadOptions` that mean something to it, apart from `every`."""


def _without_options(load: Callable[[Path], Recording]) -> Callable[[Path, ReadOptions], Recording]:
    return lambda root, _: load(root)


FORMATS: dict[str, Format] = {
    "generic": Format(generic.detect, _without_options(generic.load), "scene.json"),
    "7scenes": Format(
        seven_scenes.detect,
        _without_options(seven_scenes.load),
        "TrainSplit.txt, TestSplit.txt and seq-XX folders",
    ),
    "12scenes": Format(
        twelve_scenes.detect, _without_options(twelve_scenes.load), "info.txt and data"
    ),
    "nerfstudio": Format(nerfstudio.detect, _without_options(nerfstudio.load), "transforms.json"),
    "colmap": Format(
        colmap.detect, _without_options(colmap.load), "sparse/0 with cameras and images"
    ),
    "wrist": Format(
        wrist.detect,
        wrist.load,
        "images beside base_from_gripper.csv or joints.csv",
        wrist.USES,
    ),
    "lerobot": Format(lerobot.detect, lerobot.load, "meta/info.json", lerobot.USES),
    "rosbag": Format(
        ros_bag.detect, ros_bag.load, "a .bag or .mcap file or bag folder", ros_bag.USES
    ),
}


def load_recording(
    path: str | os.PathLike[str],
    format: str | None = None,
    name: str | None = None,
    options: ReadOptions | None = None,
) -> Recording:
    """Reads a recorded scene.

    Args:
        path: The scene's folder, or the file of a bag.
        format: One of `FORMATS`; recognised from the files when left out.
        name: What the scene is called; else the name in its file or that of its folder.
        options: What the recording does not say itself.

    Raises:
        InputError: The recording is missing, of no known format, or broken, or an option means
            nothing to its format.
    """
    root, options = Path(path), options or ReadOptions()
    if format is not None and format not in FORMATS:
        raise InputError(f"format {format!r} is not known; use one of {', '.join(FORMATS)}")
    if not root.exists():
        raise InputError(f"{root}: no such folder; give the folder of a recorded scene")
    if format is None:
        format = next((key for key, entry in FORMATS.items() if entry.detect(root)), None)
    if format is None:
        what = "no known scene format" if root.is_dir() else "a file, not a folder, and no bag"
        known = ", ".join(f"{entry.shows} ({key})" for key, entry in FORMATS.items())
        raise InputError(f"{root}: {what}; expected {known}")
    _refuse_unused(format, options)
    scene = FORMATS[format].load(root, options)
    if options.every > 1:
        scene = dataclasses.replace(
            scene, train=scene.train[:: options.every], test=scene.test[:: options.every]
        )
    return scene if name is None else dataclasses.replace(scene, name=name)


def _refuse_unused(format: str, options: ReadOptions) -> None:
    """Raises for options that would be passed over in silence."""
    if options.every < 1:
        raise InputError(f"--every {options.every}: give a number >= 1")
    for name in options.given():
        if name != "every" and name not in FORMATS[format].uses:
            users = [key for key, entry in FORMATS.items() if name in entry.uses]
            raise InputError(
                f"{flag(name)}: means nothing to a recording of format {format}, only to"
                f" {', '.join(users)}; leave it out"
            )
