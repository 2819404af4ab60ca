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
from evercal.recordings.frame import Recording
from evercal.storage.text_files import read_text

_SOURCE = "https://github.com/tsattler/visloc_pseudo_gt_limitations"
"""Repository of the pose files."""


def with_sfm_poses(recording: Recording, folder: Path, name: str) -> Recording:
    """Replace poses and focal lengths of a recording and keep its split.

    Files in `folder` begin with `name`, such as chess or apt1_kitchen.
    """
    splits = []
    lost = 0
    for split, frames in (("train", recording.train), ("test", recording.test)):
        file = folder / f"{name}_{split}.txt"
        poses = _read(file)
        posed = []
        for frame in frames:
            key = _key(frame.name)
            if key not in poses:
                continue
            pose, focal = poses[key]
            camera = frame.camera
            camera = replace(
                camera,
                fx=focal,
                fy=focal,
                # The middle of the image, counted from the centre of the first pixel.
                cx=(camera.width - 1) / 2,
                cy=(camera.height - 1) / 2,
            )
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


def _read(file: Path) -> dict[str, tuple[SE3, float]]:
    text = read_text(file, "pose file", f"get the folder pgt/sfm of {_SOURCE}")
    poses = {}
    for number, line in enumerate(filter(str.strip, text.splitlines()), start=1):
        name, *words = line.split()
        try:
            poses[_key(name)] = _pose_and_focal(words)
        except ValueError:
            raise InputError(
                f"{file}: line {number} is not 'image qw qx qy qz tx ty tz focal': {line[:60]!r}"
            ) from None
    return poses


def _pose_and_focal(words: list[str]) -> tuple[SE3, float]:
    """base_from_camera and focal length of a line; ValueError for other words."""
    numbers = np.array(list(map(float, words)))
    if len(numbers) != 8 or not np.isfinite(numbers).all() or numbers[7] <= 0:
        raise ValueError
    quaternion = numbers[:4] / np.linalg.norm(numbers[:4])
    camera_from_base = SE3(quaternion, numbers[4:7])
    return camera_from_base.inverse(), float(numbers[7])
