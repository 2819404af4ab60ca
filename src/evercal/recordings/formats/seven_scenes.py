"""The folder layout of Microsoft's 7-Scenes, see docs/formats.md.

Without an intrinsics file the focal length is 525 pixels at 640x480, as is usual, scaled with the
image size, and the principal point is the middle of the image. Poses with inf or nan mark untracked
frames, which are left out and counted. All sequences come from one camera.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.cameras.camera_file import centred_camera, read_camera_of_size
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import files_in, first_size
from evercal.recordings.poses.row_files import is_number
from evercal.recordings.read_options import ReadOptions
from evercal.storage.text_files import named_errors, read_text, refuse_repeated
from evercal.typing import Array

_SPLITS = ("TrainSplit.txt", "TestSplit.txt")
"""Files that list sequences."""
_FOCAL_AT_640 = 525.0
"""Focal length at 640x480, pixels."""
COLOUR_FROM_DEPTH = SE3.from_matrix(
    np.array(
        [
            [0.99996518, 0.00267651, -0.00790410, -0.02555894],
            [-0.00274093, 0.99996303, -0.00815045, 0.00010110],
            [0.00788199, 0.00817183, 0.99993555, 0.00203183],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
)
"""Pose of the depth camera in the colour camera of a Kinect of the same model. Measured by LIRIS
(https://projet.liris.cnrs.fr/voir/activities-dataset/kinect-calibration.html); ACE and GLACE take
it for 7-Scenes."""
_ROTATION_TOLERANCE = 1e-2
"""Largest deviation of a pose from a rotation: poses are printed with few digits, or chained in
float32."""


def detect(root: Path) -> bool:
    """Whether `root` looks like this format, even if it is damaged."""
    if not root.is_dir():
        return False
    has_split = any((root / split).is_file() for split in _SPLITS)
    return has_split or any(root.glob("seq-*/"))


def load(root: Path, options: ReadOptions) -> Recording:
    """Read split files and poses, and the size of one image; no other image is opened."""
    folders: list[Path] = []
    splits: list[list[Path]] = []
    for name in _SPLITS:
        images: list[Path] = []
        for folder in _sequences(root, name):
            if folder in folders:
                raise InputError(
                    f"{root}: {folder.name} comes twice in {' and '.join(_SPLITS)}; keep one"
                )
            folders.append(folder)
            images += colour_images(folder)
        splits.append(images)
    if not folders:
        raise InputError(
            f"{root}: {' and '.join(_SPLITS)} are empty; name a sequence in one"
        )
    camera = _camera(root, splits[0] + splits[1])
    stated_from_camera = SE3.identity()
    if options.depth_poses:
        stated_from_camera = COLOUR_FROM_DEPTH.inverse()
    return tracked_recording(root, splits, camera, stated_from_camera)


def _sequences(root: Path, split: str) -> list[Path]:
    file = root / split
    text = read_text(
        file, "split file", "write lines like 'sequence1' for the seq-XX folders"
    )
    folders = []
    for line in filter(None, map(str.strip, text.splitlines())):
        match = re.fullmatch(r"(?:sequence|seq-?)?(\d+)", line, re.IGNORECASE)
        if not match:
            raise InputError(
                f"{file}: cannot read line {line!r}; a line looks like 'sequence1'"
            )
        folder = root / f"seq-{int(match[1]):02d}"
        if not folder.is_dir():
            raise InputError(
                f"{file}: line {line!r} names {folder.name}, which is not in {root}"
            )
        folders.append(folder)
    return folders


def _camera(root: Path, images: Sequence[Path]) -> Camera:
    size = first_size(images)
    file = root / "camera-intrinsics.txt"
    if file.exists():
        return read_camera_of_size(file, size, images[0].name)
    return centred_camera(_FOCAL_AT_640 * max(size) / 640, size)


def colour_images(folder: Path) -> list[Path]:
    """Colour images of a folder, sorted by name."""
    endings = (".color.png", ".color.jpg", ".color.jpeg")
    images = files_in(folder, endings)
    if not images:
        raise InputError(
            f"{folder}: no images; expected frame-XXXXXX.color.png or .jpg"
        )
    with named_errors(folder, "images"):
        names = [_frame_name(image.name) for image in images]
        refuse_repeated(names, "keep its .png or its .jpg")
    return images


def _frame_name(image: str) -> str:
    return image[: image.rindex(".color.")]


def tracked_recording(
    root: Path,
    splits: Sequence[Sequence[Path]],
    camera: Camera,
    stated_from_camera: SE3 | None = None,
) -> Recording:
    """A recording of training and test images, and of the pose files beside them.

    Poses with inf or nan are dropped and counted. With `stated_from_camera`, names of frames begin
    with the name of the folder.
    """
    train, test = (_tracked(images, camera, stated_from_camera) for images in splits)
    untracked = sum(map(len, splits)) - len(train) - len(test)
    return Recording(root.resolve().name, train, test, untracked)


def _tracked(
    images: Sequence[Path], camera: Camera, stated_from_camera: SE3 | None
) -> tuple[Frame, ...]:
    frames = []
    for image in images:
        name = _frame_name(image.name)
        file = image.with_name(f"{name}.pose.txt")
        matrix = _matrix(file)
        if np.isfinite(matrix).all():
            with named_errors(file, "pose"):
                pose = SE3.from_matrix(matrix, _ROTATION_TOLERANCE)
            if stated_from_camera:
                name = f"{image.parent.name}/{name}"
                pose @= stated_from_camera
            frames.append(Frame(name, image, camera, pose))
    return tuple(frames)


def _matrix(file: Path) -> Array:
    """(4, 4) of a small text file."""
    # float() on the words: np.loadtxt takes longer per file than reading the file.
    # Windows prints -1.#INF, 1.#QNAN and -nan(ind).
    what = "4x4 base_from_camera matrix"
    words = re.sub(r"\S*[#(]\S*", "nan", read_text(file, what)).split()
    if len(words) != 16 or not all(map(is_number, words)):
        raise InputError(f"{file}: expected a {what} of 16 numbers, got {len(words)}")
    return np.reshape([*map(float, words)], (4, 4))
