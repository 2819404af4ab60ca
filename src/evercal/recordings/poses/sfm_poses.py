"""Structure-from-motion poses for 7-Scenes and 12-Scenes, to be put in place of the original ones.

The files of Brachmann et al., On the Limits of Pseudo Ground Truth in Visual Camera
Re-Localization (ICCV 2021), one for each split of a scene:

    FOLDER/chess_train.txt, chess_test.txt          or apt1_kitchen_train.txt, ...
        seq-01/frame-000768.color.png qw qx qy qz tx ty tz f

The pose maps the world to the camera (COLMAP's convention, metres), f is the focal length in pixels
of the image as published. The files name no principal point: COLMAP keeps it at (width / 2, height
/ 2) unless told otherwise, counted from the image's corner, which is ((width - 1) / 2, (height - 1)
/ 2) here, where pixel (0, 0) is a centre. It replaces that of the original calibration, with which
these focal lengths were not found. Frames that the reconstruction does not hold are left out and
counted.
Which poses are truer nobody knows; results under both belong side by side.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame, Recording


def with_sfm_poses(scene: Recording, folder: Path, name: str) -> Recording:
    """A scene with the poses and focal lengths of the files in a folder.

    Args:
        scene: as its images and original poses have it; the split stays.
        folder: of the pose files.
        name: their first part, such as chess or apt1_kitchen.

    Raises:
        InputError: a file that is missing or broken, or none of whose frames is in the scene.
    """
    found, lost = [], 0
    for split, frames in (("train", scene.train), ("test", scene.test)):
        file = folder / f"{name}_{split}.txt"
        known = _read(file)
        kept = tuple(_placed(f, *known[_key(f.name)]) for f in frames if _key(f.name) in known)
        if frames and not kept:
            first = _key(frames[0].name)
            raise InputError(f"{file}: no frame of {scene.name} is in it, such as {first}")
        found.append(kept)
        lost += len(frames) - len(kept)
    return replace(scene, train=found[0], test=found[1], untracked=scene.untracked + lost)


def _placed(frame: Frame, base_from_camera: SE3, focal: float) -> Frame:
    c = frame.camera
    middle = (c.width - 1) / 2, (c.height - 1) / 2
    camera = Camera(c.width, c.height, focal, focal, *middle, c.distortion)
    return replace(frame, camera=camera, base_from_camera=base_from_camera)


def _key(name: str) -> str:
    """Sequence and number of a frame, whatever its extension: 12-Scenes names no sequence."""
    stem = name.split(".color.")[0]
    return stem.removeprefix("data/")


def _read(file: Path) -> dict[str, tuple[SE3, float]]:
    try:
        lines = file.read_text().splitlines()
    except (OSError, UnicodeDecodeError):
        raise InputError(
            f"{file}: missing; get the folder pgt/sfm of "
            "https://github.com/tsattler/visloc_pseudo_gt_limitations"
        ) from None
    found = {}
    for number, line in enumerate(filter(str.strip, lines), start=1):
        name, *words = line.split()
        try:
            numbers = np.array([float(word) for word in words])
            if len(numbers) != 8 or not np.isfinite(numbers).all() or numbers[7] <= 0:
                raise ValueError
            turn = numbers[:4] / np.linalg.norm(numbers[:4])
            camera_from_base = SE3(turn, numbers[4:7])
        except ValueError:
            raise InputError(
                f"{file}: line {number} is not 'image qw qx qy qz tx ty tz focal': {line[:60]!r}"
            ) from None
        found[_key(name)] = camera_from_base.inverse(), float(numbers[7])
    return found
