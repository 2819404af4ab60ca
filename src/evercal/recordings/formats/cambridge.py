"""Cambridge Landmarks (Kendall et al., PoseNet, ICCV 2015).

    KingsCollege/dataset_train.txt, dataset_test.txt
        three lines of header, then: seq1/frame00001.png X Y Z W P Q R
    KingsCollege/seq1/frame00001.png, ...
    KingsCollege/reconstruction.nvm

X Y Z is the camera's position in metres. W P Q R is the quaternion (w first) that turns the base
frame into the camera frame, whose axes are x right, y down, z forward. The lists do not say so: it
is how ACE's setup_cambridge.py (github.com/nianticlabs/ace) projects the points of
reconstruction.nvm with them, and how VisualSFM documents that file, from which they were made.

reconstruction.nvm states a focal length for each image. The principal point is the middle of the
image, and the radial distortion of the file is not applied, as in ACE. Positions beyond 10 km are
errors of the lists (GreatCourt has one) and count as untracked.
"""

from itertools import islice
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.cameras.camera_file import centred_camera, read_camera_of_size
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import first_size
from evercal.recordings.poses.row_files import numbers_by_image
from evercal.recordings.read_options import ReadOptions
from evercal.storage.text_files import named_errors, path_inside, read_text

_LISTS = ("dataset_train.txt", "dataset_test.txt")
"""Lists of training and test images."""
_LAYOUT = "image X Y Z W P Q R"
"""A line of a list."""
_HEADER = 3
"""Lines of a list before the first image."""
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
"""Signs of the inverse rotation."""
_FARTHEST_M = 1e4
"""Farthest plausible position, metres."""


def detect(root: Path) -> bool:
    """Whether `root` holds one of the lists."""
    return any(map(Path.is_file, map(root.joinpath, _LISTS)))


def load(root: Path, options: ReadOptions) -> Recording:
    """Read the lists, focal lengths, and the size of one image; no other image is opened."""
    lists = list(map(_poses, map(root.joinpath, _LISTS)))
    names = [*lists[0], *lists[1]]
    if not names:
        raise InputError(f"{root}: {' and '.join(_LISTS)} name no image")
    cameras = _cameras(root, names, options.camera)
    splits = []
    for poses in lists:
        frames = []
        for name, pose in poses.items():
            camera = cameras.get(_stem(name))
            if camera and np.abs(pose.translation_m).max() < _FARTHEST_M:
                frames.append(Frame(name, root / name, camera, pose))
        splits.append(tuple(frames))
    train, test = splits
    lost = len(names) - len(train) - len(test)
    return Recording(root.resolve().name, train, test, lost)


def _poses(file: Path) -> dict[str, SE3]:
    """base_from_camera of each image of a list."""
    text = read_text(file, "list of images")
    rows = text.splitlines()[_HEADER:]
    poses = {}
    with named_errors(file, "list of images"):
        for name, numbers in numbers_by_image("\n".join(rows), _LAYOUT).items():
            inverse = np.array(numbers[3:]) * _CONJUGATE
            pose = SE3(inverse, np.array(numbers[:3]))
            poses[path_inside(name, "the name of an image")] = pose
    return poses


def _cameras(root: Path, names: list[str], file: Path | None) -> dict[str, Camera]:
    """The camera of each image by `_stem`, from a file for all or from the reconstruction."""
    size = first_size(list(map(root.joinpath, names)))
    if file:
        camera = read_camera_of_size(file, size, names[0])
        return dict.fromkeys(map(_stem, names), camera)
    file = root / "reconstruction.nvm"
    if not file.is_file():
        raise InputError(
            f"{root}: states no intrinsics; give `camera` (a 3x3 matrix as text, JSON or YAML), or"
            f" put {file.name} there"
        )
    cameras = {}
    with (
        named_errors(file, "reconstruction"),
        file.open(encoding="utf-8-sig") as stream,
    ):
        lines = filter(str.strip, stream)
        if not next(lines, "").startswith("NVM_V3"):
            raise ValueError("begins with NVM_V3")
        for line in islice(lines, int(next(lines, "0"))):
            name, focal, *_ = line.split()
            cameras[_stem(name)] = centred_camera(float(focal), size)
    return cameras


def _stem(name: str) -> str:
    """Name of an image without its ending: lists name .png, reconstructions .jpg."""
    return name.rpartition(".")[0]
