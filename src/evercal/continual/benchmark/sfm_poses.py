"""Structure-from-motion poses that replace the original poses of 7-Scenes and 12-Scenes.

The files are from Brachmann et al., On the Limits of Pseudo Ground Truth in Visual Camera
Re-Localization (ICCV 2021), one for each split of a scene:

    FOLDER/chess_train.txt, chess_test.txt          or apt1_kitchen_train.txt, ...
        seq-01/frame-000768.color.png qw qx qy qz tx ty tz f

The pose is camera_from_world in metres, and f is the focal length in pixels of the published image.
The files state no principal point. COLMAP keeps it at the middle of the image, and these focal
lengths were estimated with it, so it replaces that of the original calibration. Frames outside the
reconstruction count as untracked. It is unknown which poses are more accurate: report results under
both.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.cameras.camera_file import centred_camera
from evercal.recordings.formats.cambridge import numbers_by_image
from evercal.recordings.frame import Recording
from evercal.recordings.load import naming_archives
from evercal.storage.text_files import named_errors, read_text

_SOURCE = "https://github.com/tsattler/visloc_pseudo_gt_limitations"
"""Repository of the pose files."""
_LAYOUT = "image qw qx qy qz tx ty tz focal"
"""A line of a pose file."""


def with_sfm_poses(recording: Recording, folder: Path, name: str) -> Recording:
    """Replace poses and focal lengths of a recording and keep its split.

    Files in `folder` begin with `name`, such as chess or apt1_kitchen.
    """
    splits = []
    lost = 0
    for split, frames in (("train", recording.train), ("test", recording.test)):
        file = folder / f"{name}_{split}.txt"
        _require(file)
        poses = _read(file)
        posed = []
        for frame in frames:
            key = _key(frame.name)
            if key not in poses:
                continue
            pose, focal = poses[key]
            with named_errors(file, "pose file"):
                camera = centred_camera(focal, frame.camera.size)
            posed.append(replace(frame, camera=camera, base_from_camera=pose))
        if frames and not posed:
            first = _key(frames[0].name)
            raise InputError(
                f"{file}: no frame of {recording.name} is in it, such as {first}"
            )
        splits.append(tuple(posed))
        lost += len(frames) - len(posed)
    return replace(
        recording, train=splits[0], test=splits[1], untracked=recording.untracked + lost
    )


def _key(name: str) -> str:
    # Sequence and number without an ending; 12-Scenes has no sequence.
    return name.split(".color.")[0].removeprefix("data/")


def _require(file: Path) -> None:
    """In the repository, refuse another folder than that of the poses and name the right one."""
    folder = file.parent.resolve()
    is_other = folder.parent.name == "dslam" or not file.is_file()
    for place in (folder, *folder.parents):
        for found in place.glob(f"pgt/sfm/*/{file.name}"):
            if is_other:
                raise InputError(
                    f"{folder}: not the poses of structure from motion; give `poses`"
                    f" {found.parent}"
                )


def _read(file: Path) -> dict[str, tuple[SE3, float]]:
    """base_from_camera and focal length of each frame."""
    with naming_archives(file):
        text = read_text(file, "pose file", f"get the folder pgt/sfm of {_SOURCE}")
    rows = numbers_by_image(file, text, _LAYOUT)
    poses = {}
    with named_errors(file, "pose file"):
        for name, (*pose, focal) in rows.items():
            camera_from_base = SE3(np.array(pose[:4]), np.array(pose[4:]))
            poses[_key(name)] = (camera_from_base.inverse(), focal)
    return poses
