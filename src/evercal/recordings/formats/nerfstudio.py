"""nerfstudio's `transforms.json`, as written by phone apps, `ns-process-data` and ScanNet++.

`transform_matrix` is the camera in the world with OpenGL's axes (y up, looking along -z).
Intrinsics stand at the top or in each frame. The centre of the top-left pixel is (0.5, 0.5), as in
COLMAP. `applied_transform` and `applied_scale` are undone, so the base frame and the unit of length
are set by the program that estimated the poses. Files in `val_filenames` and `test_filenames`,
entries of `test_frames`, and Blender's transforms_val.json and transforms_test.json are test
frames. (Tancik et al., Nerfstudio, SIGGRAPH 2023; its documentation, Data conventions.)
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import (
    IMAGE_ENDINGS,
    as_stored,
    first_size,
    image_size,
    is_readable,
)
from evercal.recordings.poses.row_files import number_array
from evercal.recordings.read_options import ReadOptions
from evercal.storage.text_files import (
    is_real,
    named_errors,
    naming,
    read_json,
    refuse_repeated,
)
from evercal.typing import Array

FILE = "transforms.json"
# The first one there is read. ScanNet++ keeps undistorted images beside those of the fisheye lens.
_FILES = (
    "transforms_undistorted.json", FILE, "transforms_train.json",
    "nerfstudio/transforms_undistorted.json", f"nerfstudio/{FILE}",
    "dslr/nerfstudio/transforms_undistorted.json", f"dslr/nerfstudio/{FILE}",
)  # fmt: skip
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV_FISHEYE")
# OpenGL axes (right, up, backward) from OpenCV axes (right, down, forward).
_GL_FROM_CV = SE3(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(3))
_LENS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Numbers of `distortion_params`, in this order."""
_TOLERANCE = 1e-2
USES = ("metres",)


def frame_note(file: str, metric: bool) -> str:
    """What the recording leaves open: its base frame and, unless `metric`, its unit of length."""
    if metric:
        return f"the base frame is that of {file}; if it is not the robot's, run 'evercal align'"
    return (
        f"the base frame and the unit of length are those of {file}: run 'evercal align' after"
        " learning, or give --metres if the poses are in metres"
    )


def detect(root: Path) -> bool:
    """Whether `root` holds, or is, a transforms.json or a file of that kind."""
    named = (
        root.name.startswith("transforms") and root.suffix == ".json" and root.is_file()
    )
    return named or any((root / name).is_file() for name in _FILES)


def load(root: Path, options: ReadOptions | None = None) -> Recording:
    """Read the poses and the size of one image of every camera; no other image is opened."""
    metric = options is not None and options.metres
    files = [root / name for name in _FILES if (root / name).is_file()] or [root / FILE]
    file = root if root.is_file() else files[0]
    frames, test, bad = _frames(file)
    splits = (
        ("val", "test")
        if file.name == "transforms_train.json" and root.is_dir()
        else ()
    )
    for other in filter(
        Path.is_file, (root / f"transforms_{split}.json" for split in splits)
    ):
        more, _, left_out = _frames(other)
        frames = [*frames, *more]
        bad = bad + left_out
        test |= {frame.name for frame in more}
    with named_errors(file, "nerfstudio file"):
        refuse_repeated(
            (frame.name for frame in frames), "keep one entry for each image"
        )
    notes = [f"{bad} frames are marked as bad and left out"] if bad else []
    return Recording(
        (root if root.is_dir() else file.parent).resolve().name,
        tuple(frame for frame in frames if frame.name not in test),
        tuple(frame for frame in frames if frame.name in test),
        bad,
        notes=(*notes, frame_note(file.name, metric)),
        metric=metric,
    )


def _frames(file: Path) -> tuple[list[Frame], set[str], int]:
    """Frames of a file, names of test frames, and the number of frames that are marked as bad."""
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
            kind = "undistorted_images" if "undistorted" in file.name else "images"
            folders = (root, root.parent / kind, root.parent / f"resized_{kind}")
            name = str(first["file_path"])
            root = next(
                (each for each in folders if _image(each, name).is_file()), root
            )
            # Without a stated image size, that of the first image is taken.
            if not {"w", "h"} & {*data, *first}:
                names = [
                    each.get("file_path") for each in entries if isinstance(each, dict)
                ]
                width, height = first_size([_image(root, str(each)) for each in names])
                data |= {"w": width, "h": height}
        every = [*entries, *tested]
        frames = []
        bad = [isinstance(each, dict) and bool(each.get("is_bad")) for each in every]
        for i, entry in ((i, entry) for i, entry in enumerate(every) if not bad[i]):
            with naming(f"frame {i}"):
                frames.append(_frame(root, data, entry, undo, scale))
        names = [str(each.get("file_path")) for each in every]
        test = _test_names(root, data, names) | {*names[len(entries) :]}
    return _resized(file, frames), test, sum(bad)


def _applied(data: Mapping[str, object]) -> tuple[SE3, float]:
    scale = _number(data, "applied_scale", 1.0)
    if not scale > 0:
        raise ValueError(f"'applied_scale' is > 0, got {scale}")
    if data.get("applied_transform") is None:
        return SE3.identity(), scale
    matrix = _matrix(data["applied_transform"], "applied_transform")[:3]
    size = abs(np.linalg.det(matrix[:, :3])) ** (1 / 3)
    if not size > 0:
        raise ValueError("'applied_transform' cannot be undone: its determinant is 0")
    with naming("'applied_transform'"):
        return SE3.from_matrix(matrix / size, _TOLERANCE).inverse(), scale * size


def _frame(
    root: Path, data: Mapping[str, object], entry: object, undo: SE3, scale: float
) -> Frame:
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
        raise ValueError("an object with 'file_path' and 'transform_matrix'")
    name = entry["file_path"]
    with naming(name):
        matrix = _matrix(entry.get("transform_matrix"), "transform_matrix")
        stated = SE3.from_matrix(matrix, _TOLERANCE)
        camera = _camera({**data, **entry})
    world_from_gl = undo @ SE3(stated.rotation_wxyz, stated.translation_m / scale)
    return Frame(name, _image(root, name), camera, world_from_gl @ _GL_FROM_CV)


def _image(root: Path, name: str) -> Path:
    image = root / PureWindowsPath(name).as_posix()
    if image.suffix.lower() in IMAGE_ENDINGS:
        return image
    return next(
        (f for e in IMAGE_ENDINGS if (f := Path(f"{image}{e}")).is_file()), image
    )


def _camera(data: Mapping[str, object]) -> Camera:
    model = data.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise ValueError(
            f"camera_model {model!r} is not supported, only {', '.join(_MODELS)}; undistort the"
            f" images first (for COLMAP: colmap image_undistorter)"
        )
    fisheye = model == "OPENCV_FISHEYE" or bool(data.get("is_fisheye"))
    own = [_number(data, key, 0.0) for key in _LENS]
    lens = number_array(
        data.get("distortion_params", own), "'distortion_params'"
    ).tolist()
    none = [4, 5] if fisheye else [3]
    if (
        len(lens) != len(own)
        or any(lens[i] for i in none)
        or (any(own) and lens != own)
    ):
        zeros = " and ".join(_LENS[i] for i in none)
        raise ValueError(
            f"distortion is {', '.join(_LENS)}, with {zeros} 0 for {model}, also as"
            f" 'distortion_params', got {lens}"
        )
    width = _number(data, "w")
    height = _number(data, "h")
    fx = _focal(data, "x", width)
    fy = _focal(data, "y", height)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None:
        raise ValueError("'fl_x' is missing, and so are 'fl_y' and 'camera_angle_x'")
    # Half a pixel: the file counts from the image's corner.
    cx = _number(data, "cx", width / 2) - 0.5
    cy = _number(data, "cy", height / 2) - 0.5
    distortion = tuple(lens[i] for i in ((0, 1, 2, 3) if fisheye else (0, 1, 4, 5, 2)))
    size: Any = width, height  # whole numbers, checked when constructed
    kind = "fisheye" if fisheye else "pinhole"
    return Camera(size[0], size[1], fx, fy, cx, cy, distortion, kind)


def _focal(data: Mapping[str, object], axis: str, size: float) -> float | None:
    if data.get(f"fl_{axis}") is not None:
        return _number(data, f"fl_{axis}")
    if data.get(f"camera_angle_{axis}") is None:
        return None
    angle = _number(data, f"camera_angle_{axis}")
    if not 0 < angle < math.pi:
        raise ValueError(
            f"'camera_angle_{axis}' is between 0 and pi radians, got {angle}"
        )
    return size / 2 / math.tan(angle / 2)


def _resized(file: Path, frames: list[Frame]) -> list[Frame]:
    """Frames with cameras of their images' size, judged by one image of every camera size.

    Downscaled copies of the images get scaled cameras. Images are taken as they are stored, as by
    nerfstudio, unless only their EXIF orientation gives them the stated shape. Rotated and cropped
    images are refused.
    """
    taken: dict[tuple[int, int], tuple[tuple[int, int], Any]] = {}
    resized = []
    for frame in frames:
        stated = frame.camera.width, frame.camera.height
        assert isinstance(frame.image, Path)
        if stated not in taken and is_readable(frame.image):
            ways = [(image_size(way(frame.image)), way) for way in (as_stored, Path)]
            apart = [abs(w / h / (stated[0] / stated[1]) - 1) for (w, h), _ in ways]
            size, _ = taken[stated] = ways[apart.index(min(apart))]
            if min(apart) > 0.01:
                rotated = "the image was rotated after the intrinsics were written"
                raise InputError(
                    f"{frame.image}: is {size[0]}x{size[1]}, {file.name} says"
                    f" {stated[0]}x{stated[1]} ({rotated if size == stated[::-1] else 'cropped?'});"
                    f" give images of that shape"
                )
        size, way = taken.get(stated, (stated, Path))
        camera = frame.camera if size == stated else frame.camera.resized(*size)
        resized.append(replace(frame, image=way(frame.image), camera=camera))
    return resized


def _test_names(root: Path, data: Mapping[str, object], frames: list[str]) -> set[str]:
    name_of = {_image(root, name): name for name in frames}
    test = set()
    for key in ("val_filenames", "test_filenames"):
        names = data.get(key, [])
        if not isinstance(names, list) or not all(
            isinstance(name, str) for name in names
        ):
            raise ValueError(f"{key!r} is a list of file names")
        # A test frame under another name would be learned from.
        other = [name for name in names if _image(root, name) not in name_of]
        if other:
            raise ValueError(
                f"{key!r} names {other[0]!r}, which is no frame; correct the name"
            )
        test |= {name_of[_image(root, name)] for name in names}
    return test


def _matrix(value: object, name: str) -> Array:
    matrix = number_array(value, repr(name))
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise ValueError(f"{name!r} is 4x4 or 3x4 numbers, got {str(value)[:60]}")
    return matrix


def _number(
    data: Mapping[str, object], name: str, default: float | None = None
) -> float:
    value: Any = data.get(name, default)
    if not is_real(value) or not math.isfinite(value):
        what = "is missing" if value is None else f"is a number, got {value!r}"
        raise ValueError(f"{name!r} {what}")
    return float(value)
