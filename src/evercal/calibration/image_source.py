"""`Images`: images of one camera as a caller gives them, with intrinsics and gripper poses."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.image_files import image_files
from evercal.recordings.images import NamedPictures, as_rgb
from evercal.recordings.poses.pairing import poses_of_images
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.typing import PathLike, Strings

ImageSource = PathLike | np.ndarray | Sequence[PathLike] | Sequence[np.ndarray]
"""A folder, an image file or an array (H, W, 3), or several files or arrays."""


@frozen_arrays
class Images:
    """Images of one camera, with intrinsics and gripper poses if known."""

    images: NamedPictures
    """Names and pictures, which are read one at a time."""
    camera: Camera | None = None
    """Intrinsics. None: those of the camera that recorded the scene, or of another of its model."""
    base_from_gripper: SE3 | None = None
    """(n,) gripper pose at each image."""
    notes: Strings = ()
    """How poses and images were paired."""
    frames: FrameNames = UNKNOWN
    """Names of the frames of the gripper poses, and of the camera, where they are known."""

    def __post_init__(self) -> None:
        grippers = self.base_from_gripper
        if grippers is None:
            return
        if not isinstance(grippers, SE3) or not grippers.shape:
            raise InputError(
                "`robot_poses`: give a file, or SE3.stack of one pose for every image"
            )
        if len(grippers) != len(self.images):
            raise InputError(
                f"{len(self.images)} images and {len(grippers)} robot poses: give one pose for"
                " every image"
            )

    @classmethod
    def of(
        cls,
        source: ImageSource,
        camera: Camera | None = None,
        robot_poses: PathLike | SE3 | None = None,
        convention: str | None = None,
        frames: FrameNames = UNKNOWN,
    ) -> Self:
        """Take images from files or arrays, see `Map.calibrate`."""
        items = _items(source)
        are_paths = [isinstance(item, str | os.PathLike) for item in items]
        if all(are_paths):
            files = image_files(items)
            poses = robot_poses
            notes = []
            if isinstance(poses, str | os.PathLike):
                poses, notes = poses_of_images(Path(poses), files, convention)
            named = [(str(path), path) for path in files]
            return cls(named, camera, poses, tuple(notes), frames)
        if isinstance(robot_poses, str | os.PathLike):
            raise InputError(
                f"{robot_poses}: a file of robot poses is paired with image files by name, time or"
                " order; give poses (n,) with images from arrays"
            )
        if any(are_paths):
            raise InputError("images: files and arrays; give either of them")
        arrays = [(f"image {i}", as_rgb(image)) for i, image in enumerate(items)]
        return cls(arrays, camera, robot_poses, frames=frames)


def _items(source: ImageSource) -> list[Any]:
    """The files or arrays of a source."""
    if isinstance(source, str | os.PathLike):
        return [source]
    if isinstance(source, np.ndarray) and source.ndim < 4:
        return [source]
    try:
        return list(source)
    except TypeError:
        kind = type(source).__name__
        raise InputError(
            f"images: {kind}; give a folder, image files, or arrays (H, W, 3)"
        ) from None
