"""Frames of 7-Scenes and 12-Scenes with one of their sets of poses.

The original poses lie beside the images; inf or nan marks an untracked frame. Those of 7-Scenes
are of the depth camera.

Others are by structure from motion (Brachmann et al., On the Limits of Pseudo Ground Truth in
Visual Camera Re-Localization, ICCV 2021), in a file for each split of a scene:

    FOLDER/chess_train.txt, chess_test.txt          or apt1_kitchen_train.txt, ...
        seq-01/frame-000768.color.png qw qx qy qz tx ty tz f

The pose is camera_from_world in metres, and f is the focal length in pixels of the published image.
The files state no principal point. COLMAP keeps it at the middle of the image, and these focal
lengths were estimated with it. Frames outside the reconstruction count as untracked; some have no
original pose. It is unknown which poses are more accurate: report results under both.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.cameras.camera_file import centred_camera
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.poses.row_files import is_number, numbers_by_image
from evercal.storage.text_files import named_errors, read_text
from evercal.typing import Array, Size

COLOUR_FROM_DEPTH = SE3.from_matrix(
    np.array(
        [
            [0.99996518, 0.00267651, -0.00790410, -0.02555894],
            [-0.00274093, 0.99996303, -0.00815045, 0.00010110],
            [0.00788199, 0.00817183, 0.99993555, 0.00203183],
        ]
    )
)
"""Pose of the depth camera in the colour camera of a Kinect of the same model. Measured by LIRIS
(https://projet.liris.cnrs.fr/voir/activities-dataset/kinect-calibration.html); ACE and GLACE take
it for 7-Scenes."""
_ROTATION_TOLERANCE = 1e-2
"""Largest deviation of a pose from a rotation: poses are printed with few digits, or chained in
float32."""
_SOURCE = "https://github.com/tsattler/visloc_pseudo_gt_limitations"
"""Repository of the poses by structure from motion."""
_LAYOUT = "image qw qx qy qz tx ty tz focal"
"""A line of their files."""


def tracked_recording(
    root: Path, name: str, splits: Sequence[Sequence[Path]], camera: Camera, poses: str
) -> Recording:
    """A recording of training and test images with the poses of `ReadOptions.poses`.

    `name` begins the names of files of poses by structure from motion.
    """
    recorded = []
    for split, images in zip(("train", "test"), splits, strict=True):
        by_motion = poses not in ("original", "colour")
        file = Path(poses) / f"{name}_{split}.txt"
        views = {}
        if by_motion:
            views = _by_structure_from_motion(file, camera.size)
        frames = []
        for image in images:
            key = frame_key(image.relative_to(root).as_posix())
            view = views.get(key)
            if not by_motion:
                view = (camera, _original(image, poses))
            if view and view[1]:
                frames.append(Frame(key, image, *view))
        if by_motion and images and not frames:
            first = images[0].relative_to(root)
            raise InputError(f"{file}: no frame of {root} is in it, such as {first}")
        recorded.append(tuple(frames))
    train, test = recorded
    untracked = sum(map(len, splits)) - len(train) - len(test)
    return Recording(root.resolve().name, train, test, untracked)


def _original(image: Path, poses: str) -> SE3 | None:
    """The pose beside an image; None if it is untracked."""
    file = image.with_name(f"{frame_key(image.name)}.pose.txt")
    matrix = _matrix(file)
    if not np.isfinite(matrix).all():
        return None
    with named_errors(file, "pose"):
        pose = SE3.from_matrix(matrix, _ROTATION_TOLERANCE)
    if poses == "colour":
        pose @= COLOUR_FROM_DEPTH.inverse()
    return pose


def _by_structure_from_motion(file: Path, size: Size) -> dict[str, tuple[Camera, SE3]]:
    """Camera and pose of each image by `frame_key`."""
    _require(file)
    text = read_text(file, "pose file", f"get the folder pgt/sfm of {_SOURCE}")
    poses = {}
    with named_errors(file, "pose file"):
        for name, (*pose, focal) in numbers_by_image(text, _LAYOUT).items():
            camera_from_base = SE3(np.array(pose[:4]), np.array(pose[4:]))
            own = centred_camera(focal, size)
            poses[frame_key(name)] = (own, camera_from_base.inverse())
    return poses


def frame_key(name: str) -> str:
    """Sequence and number of an image without an ending; 12-Scenes has no sequence."""
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


def _matrix(file: Path) -> Array:
    """(4, 4) of a small text file."""
    # float() on the words: np.loadtxt takes longer per file than reading the file.
    # Windows prints -1.#INF, 1.#QNAN and -nan(ind).
    what = "4x4 base_from_camera matrix"
    words = re.sub(r"\S*[#(]\S*", "nan", read_text(file, what)).split()
    if len(words) != 16 or not all(map(is_number, words)):
        raise InputError(f"{file}: expected a {what} of 16 numbers, got {len(words)}")
    return np.reshape([*map(float, words)], (4, 4))
