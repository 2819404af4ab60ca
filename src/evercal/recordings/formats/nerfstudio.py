"""nerfstudio's `transforms.json`, as written by phone apps, `ns-process-data` and ScanNet++.

`transform_matrix` is the camera in the world with OpenGL's axes (y up, looking along -z).
Intrinsics stand at the top or in each frame. The centre of the top-left pixel is (0.5, 0.5), as in
COLMAP. `applied_transform` and `applied_scale` are undone, so the base frame and the unit of length
are set by the program that estimated the poses. Files in `val_filenames` and `test_filenames`,
entries of `test_frames`, and Blender's transforms_val.json and transforms_test.json are test
frames. (Tancik et al., Nerfstudio, SIGGRAPH 2023; its documentation, Data conventions.)
"""

import math
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.geometry.camera import COEFFICIENTS
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import (
    IMAGE_ENDINGS,
    as_stored,
    first_size,
    image_size,
    is_readable,
)
from evercal.recordings.poses.conventions import OPENGL_FROM_OPENCV
from evercal.recordings.poses.row_files import number_array
from evercal.recordings.read_options import ReadOptions
from evercal.storage.text_files import (
    is_real,
    named_errors,
    naming,
    read_json,
    refuse_repeated,
)
from evercal.typing import Array, Record, Size

FILE = "transforms.json"
"""Usual name of the file."""
_FILES = (
    "transforms_undistorted.json",
    FILE,
    "transforms_train.json",
    "nerfstudio/transforms_undistorted.json",
    f"nerfstudio/{FILE}",
    "dslr/nerfstudio/transforms_undistorted.json",
    f"dslr/nerfstudio/{FILE}",
)
"""Usual places; the first one is read. ScanNet++ keeps undistorted images beside those of the
fisheye lens."""
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV_FISHEYE")
"""Camera models that are read."""
_LENS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Numbers of `distortion_params`, in this order."""
_TOLERANCE = 1e-2
"""Largest deviation of a stated matrix from a rotation."""


def frame_note(file: str, metric: bool) -> str:
    """What the recording leaves open: its base frame and, unless `metric`, its unit of length."""
    if metric:
        return f"the base frame is that of {file}; if it is not the robot's, run 'evercal align'"
    return (
        f"the base frame and the unit of length are those of {file}: run 'evercal align' after"
        " learning, or give `metres` if the poses are in metres"
    )


def detect(root: Path) -> bool:
    """Whether `root` holds, or is, a transforms.json or a file of that kind."""
    if root.is_file():
        return root.name.startswith("transforms") and root.suffix == ".json"
    return _file_in(root).is_file()


def load(root: Path, options: ReadOptions) -> Recording:
    """Read the poses and the size of one image of every camera; no other image is opened."""
    file = root if root.is_file() else _file_in(root)
    train, test, bad = _frames(file)
    if file.name == "transforms_train.json" and root.is_dir():
        for split in ("val", "test"):
            other = root / f"transforms_{split}.json"
            if other.is_file():
                more, others, more_bad = _frames(other)
                test += more + others
                bad += more_bad
    with named_errors(file, "nerfstudio file"):
        names = [frame.name for frame in train + test]
        refuse_repeated(names, "keep one entry for each image")
    notes = [frame_note(file.name, options.metres)]
    if bad:
        notes.insert(0, f"{bad} frames are marked as bad and left out")
    folder = root if root.is_dir() else file.parent
    return Recording(
        folder.resolve().name,
        tuple(train),
        tuple(test),
        bad,
        notes=tuple(notes),
        metric=options.metres,
    )


def _file_in(root: Path) -> Path:
    for name in _FILES:
        if (root / name).is_file():
            return root / name
    return root / FILE


def _frames(file: Path) -> tuple[list[Frame], list[Frame], int]:
    """Training and test frames of a file, and the number of frames that are marked as bad."""
    data = read_json(file, "nerfstudio file", "export it again")
    with named_errors(file, "nerfstudio file"):
        undo, scale = _applied(data)
        entries = data.get("frames")
        tested = data.get("test_frames", [])
        if not isinstance(entries, list) or not isinstance(tested, list) or not entries:
            raise ValueError("'frames' is a list with at least one frame")
        root = file.parent
        first = entries[0]
        if isinstance(first, dict) and "file_path" in first:
            root = _image_root(file, str(first["file_path"]))
            # Without a stated image size, that of the first image is taken.
            if {"w", "h"}.isdisjoint([*data, *first]):
                images = []
                for entry in entries:
                    if isinstance(entry, dict):
                        images.append(_image(root, str(entry.get("file_path"))))
                width, height = first_size(images)
                data["w"] = width
                data["h"] = height
        frames = []
        bad = 0
        for i, entry in enumerate([*entries, *tested]):
            if isinstance(entry, dict) and entry.get("is_bad"):
                bad += 1
                continue
            with naming(f"frame {i}"):
                frames.append(_frame(root, data, entry, undo, scale))
        names = [str(entry.get("file_path")) for entry in (*entries, *tested)]
        tests = _test_names(root, data, names).union(names[len(entries) :])
    splits: tuple[list[Frame], list[Frame]] = ([], [])
    for frame in _resized(file, frames):
        splits[frame.name in tests].append(frame)
    return *splits, bad


def _image_root(file: Path, name: str) -> Path:
    """Folder that the names of images are relative to, judged by one of them."""
    root = file.parent
    kind = "undistorted_images" if "undistorted" in file.name else "images"
    for folder in (root, root.parent / kind, root.parent / f"resized_{kind}"):
        if _image(folder, name).is_file():
            return folder
    return root


def _applied(data: Record) -> tuple[SE3, float]:
    scale = _number(data, "applied_scale", 1.0)
    if not scale > 0:
        raise ValueError(f"'applied_scale' is > 0, got {scale}")
    if data.get("applied_transform") is None:
        return SE3.identity(), scale
    matrix = _matrix(data["applied_transform"], "applied_transform")[:3]
    volume = abs(np.linalg.det(matrix[:, :3]))
    size = volume ** (1 / 3)
    if not size > 0:
        raise ValueError("'applied_transform' cannot be undone: its determinant is 0")
    with naming("'applied_transform'"):
        applied = SE3.from_matrix(matrix / size, _TOLERANCE)
        return applied.inverse(), scale * size


def _frame(root: Path, data: Record, entry: object, undo: SE3, scale: float) -> Frame:
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
        raise ValueError("an object with 'file_path' and 'transform_matrix'")
    name = entry["file_path"]
    with naming(name):
        matrix = _matrix(entry.get("transform_matrix"), "transform_matrix")
        stated = SE3.from_matrix(matrix, _TOLERANCE)
        camera = _camera({**data, **entry})
    applied_from_gl = SE3(stated.rotation_wxyz, stated.translation_m / scale)
    world_from_camera = undo @ applied_from_gl @ OPENGL_FROM_OPENCV
    return Frame(name, _image(root, name), camera, world_from_camera)


def _image(root: Path, name: str) -> Path:
    image = root / PureWindowsPath(name).as_posix()
    if image.suffix.lower() not in IMAGE_ENDINGS:
        for ending in IMAGE_ENDINGS:
            file = Path(f"{image}{ending}")
            if file.is_file():
                return file
    return image


def _camera(data: Record) -> Camera:
    model = data.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise ValueError(
            f"camera_model {model!r} is not supported, only {', '.join(_MODELS)}; undistort the"
            f" images first (for COLMAP: colmap image_undistorter)"
        )
    fisheye = model == "OPENCV_FISHEYE" or bool(data.get("is_fisheye"))
    numbers = [_number(data, key, 0.0) for key in _LENS]
    stated = data.get("distortion_params", numbers)
    coefficients = number_array(stated, "'distortion_params'").tolist()
    kind = "fisheye" if fisheye else "pinhole"
    names = COEFFICIENTS[kind][:5]
    unused = [name for name in _LENS if name not in names]
    values: dict[str, float] = dict(zip(_LENS, coefficients, strict=False))
    differs = any(numbers) and coefficients != numbers
    if differs or len(coefficients) != len(_LENS) or any(map(values.get, unused)):
        raise ValueError(
            f"distortion is {', '.join(_LENS)}, with {' and '.join(unused)} 0 for {model}, also as"
            f" 'distortion_params', got {coefficients}"
        )
    width = _number(data, "w")
    height = _number(data, "h")
    fx = _focal(data, "x", width)
    fy = _focal(data, "y", height)
    if fx is None:
        fx = fy
    if fy is None:
        fy = fx
    if fx is None or fy is None:
        raise ValueError("'fl_x' is missing, and so are 'fl_y' and 'camera_angle_x'")
    # Half a pixel: the file counts from the image's corner.
    cx = _number(data, "cx", width / 2) - 0.5
    cy = _number(data, "cy", height / 2) - 0.5
    size: Any = (width, height)  # whole numbers, checked when constructed
    distortion = tuple(values[name] for name in names)
    return Camera(size[0], size[1], fx, fy, cx, cy, distortion, kind)


def _focal(data: Record, axis: str, size: float) -> float | None:
    focal = f"fl_{axis}"
    if data.get(focal) is not None:
        return _number(data, focal)
    name = f"camera_angle_{axis}"
    if data.get(name) is None:
        return None
    angle = _number(data, name)
    if not 0 < angle < math.pi:
        raise ValueError(f"{name!r} is between 0 and pi radians, got {angle}")
    return size / 2 / math.tan(angle / 2)


def _resized(file: Path, frames: list[Frame]) -> list[Frame]:
    """Frames with cameras of their images' size, judged by one image of every camera size.

    Downscaled copies of the images get scaled cameras. Images are taken as they are stored, as by
    nerfstudio, unless only their EXIF orientation gives them the stated shape. Rotated and cropped
    images are refused.
    """
    readers: dict[Size, tuple[Size, Any]] = {}
    resized = []
    for frame in frames:
        camera = frame.camera
        stated = camera.size
        assert isinstance(frame.image, Path)
        if stated not in readers and is_readable(frame.image):
            readers[stated] = _reader(frame.image, stated, file.name)
        size, read = readers.get(stated, (stated, Path))
        if size != stated:
            camera = camera.resized(*size)
        resized.append(replace(frame, image=read(frame.image), camera=camera))
    return resized


def _reader(image: Path, stated: Size, source: str) -> tuple[Size, Any]:
    """Size of an image and how it is read, as stored or turned: whichever has the stated shape."""
    aspect = stated[0] / stated[1]
    readers = (as_stored, Path)
    sizes = [image_size(read(image)) for read in readers]
    deviations = [abs(width / height / aspect - 1) for width, height in sizes]
    least = min(deviations)
    chosen = deviations.index(least)
    size = sizes[chosen]
    if least > 0.01:
        reason = "cropped?"
        if size == stated[::-1]:
            reason = "the image was rotated after the intrinsics were written"
        raise InputError(
            f"{image}: is {size[0]}x{size[1]}, {source} says {stated[0]}x{stated[1]} ({reason});"
            f" give images of that shape"
        )
    return size, readers[chosen]


def _test_names(root: Path, data: Record, frames: list[str]) -> set[str]:
    name_of = {_image(root, name): name for name in frames}
    test = set()
    for key in ("val_filenames", "test_filenames"):
        names = data.get(key, [])
        if not isinstance(names, list) or not {*map(type, names)} <= {str}:
            raise ValueError(f"{key!r} is a list of file names")
        for name in names:
            image = _image(root, name)
            # A test frame under another name would be learned from.
            if image not in name_of:
                raise ValueError(
                    f"{key!r} names {name!r}, which is no frame; correct the name"
                )
            test.add(name_of[image])
    return test


def _matrix(value: object, name: str) -> Array:
    matrix = number_array(value, repr(name))
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise ValueError(f"{name!r} is 4x4 or 3x4 numbers, got {str(value)[:60]}")
    return matrix


def _number(data: Record, name: str, default: float | None = None) -> float:
    value: Any = data.get(name, default)
    if not is_real(value) or not math.isfinite(value):
        what = "is missing" if value is None else f"is a number, got {value!r}"
        raise ValueError(f"{name!r} {what}")
    return float(value)
