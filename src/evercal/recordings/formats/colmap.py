"""COLMAP models (Schönberger and Frahm, CVPR 2016), binary and text.

COLMAP states camera_from_world, and its pixel (0.5, 0.5) is the centre of the top-left pixel, which
is (0, 0) here. It ignores the EXIF orientation. Images without a pose count as untracked, including
files beside the images of the model. Of several models in one folder, the one with the most images
is read.
"""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from evercal.bounds import require_at_most
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.cameras.camera_fields import camera_of
from evercal.recordings.cameras.colmap_models import (
    COLMAP_PARAMETERS,
    colmap_fields,
)
from evercal.recordings.formats.nerfstudio import frame_note
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import as_stored, files_in
from evercal.recordings.read_options import ReadOptions
from evercal.storage.text_files import (
    named_errors,
    natural_key,
    path_inside,
)

_MODEL_FOLDERS = (".", "sparse", "colmap/sparse", "distorted/sparse")
"""Usual places of models; distorted/sparse is before undistortion."""
_LAYOUTS = {
    "cameras": "CAMERA_ID MODEL WIDTH HEIGHT PARAMS",
    "images": "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME",
}
"""Lines of text files; one of observations follows that of an image."""
_INCOMPLETE = "ends early or holds more than it lists; copy it again"


def detect(root: Path) -> bool:
    """Whether `root` is or holds a model."""
    return bool(_models(root))


def load(root: Path, options: ReadOptions) -> Recording:
    """Read the largest model; no image is opened whole."""
    models = {folder: _model(folder) for folder in _models(root)}
    if not models:
        raise InputError(
            f"{root}: no COLMAP model; expected cameras and images (.bin or .txt)"
        )
    folder = max(models, key=lambda folder: len(models[folder]))
    posed = models[folder]
    names = sorted(posed, key=natural_key)
    notes = [frame_note("COLMAP", options.metres)]
    if len(models) > 1:
        sizes = [f"{path.name}: {len(part)}" for path, part in models.items()]
        notes.append(
            f"took model {folder.name}, the one with the most images ({', '.join(sizes)})"
        )
    if not posed:
        raise InputError(
            f"{folder}: no image has a pose; reconstruct with more overlap"
        )
    images = _image_folder(root, folder, names)
    frames = []
    for name in names:
        camera, base_from_camera = posed[name]
        frames.append(Frame(name, as_stored(images / name), camera, base_from_camera))
    lost = 0
    if images != root:
        lost = max(0, len(files_in(images, glob="**/*")) - len(frames))
    return Recording(
        root.resolve().name,
        tuple(frames),
        (),
        lost,
        notes=tuple(notes),
        metric=options.metres,
    )


def _models(root: Path) -> list[Path]:
    """Model folders in the first of the usual places."""
    for name in _MODEL_FOLDERS:
        parent = root / name
        folders = [parent]
        if parent.is_dir():
            for folder in sorted(parent.iterdir()):
                # The root may be a folder of models, which COLMAP numbers.
                if name != "." or folder.name.isdigit():
                    folders.append(folder)
        models = [folder for folder in folders if _ending(folder)]
        if models:
            return models
    return []


def _ending(folder: Path) -> str:
    """Ending of the files of a model; as in COLMAP, binary files come before text."""
    for end in (".bin", ".txt"):
        if all((folder / (name + end)).is_file() for name in _LAYOUTS):
            return end
    return ""


def _model(folder: Path) -> dict[str, tuple[Camera, SE3]]:
    """Camera and pose of each image."""
    end = _ending(folder)
    read = _binary if end == ".bin" else _text
    cameras = {}
    file = folder / f"cameras{end}"
    with named_errors(file, "COLMAP model"):
        for key, model, width, height, *numbers in read(file):
            own = colmap_fields(model, int(width), int(height), [*map(float, numbers)])
            cameras[int(key)] = camera_of(own, None)
    images = {}
    file = folder / f"images{end}"
    with named_errors(file, "COLMAP model"):
        for _, *pose, key, name in read(file):
            name = path_inside(name, "the name of an image")
            if name in images or int(key) not in cameras:
                raise ValueError(f"{name} comes twice, or camera {key} has no entry")
            numbers = np.array(pose, float)
            camera_from_world = SE3(numbers[:4], numbers[4:])
            images[name] = (cameras[int(key)], camera_from_world.inverse())
    return images


def _text(path: Path) -> Iterator[list[str]]:
    layout = _LAYOUTS[path.stem]
    with path.open(encoding="utf-8-sig") as stream:
        for line in stream:
            words = line.split()
            if not words or line[0] == "#":
                continue
            if len(words) < len(layout.split()):
                raise ValueError(f"{line.strip()[:80]!r} is not {layout}")
            if path.stem == "images":
                # The name may have blanks; a line of observations follows.
                words = line.strip().split(maxsplit=9)
                observed = next(stream, "").split()
                last = ["0", *observed][-1]
                if len(observed) % 3 or not last.lstrip("-").isdecimal():
                    raise ValueError(
                        f"no line of observations follows that of {words[-1]};"
                        " an empty line is enough"
                    )
            yield words


def _binary(path: Path) -> Iterator[Sequence[Any]]:
    read = _stored_image if path.stem == "images" else _stored_camera
    with path.open("rb") as stream:
        (count,) = _numbers(stream, "Q")
        for _ in range(count):
            yield read(stream)
        if stream.tell() != path.stat().st_size:
            raise ValueError(_INCOMPLETE)


def _numbers(stream: BinaryIO, kinds: str) -> tuple[Any, ...]:
    """The next numbers, of kinds as in the module `struct`."""
    layout = struct.Struct(f"<{kinds}")
    data = stream.read(layout.size)
    if len(data) < layout.size:
        raise ValueError(_INCOMPLETE)
    return layout.unpack(data)


def _stored_camera(stream: BinaryIO) -> Sequence[Any]:
    key, kind, *size = _numbers(stream, "IiQQ")
    model = dict(enumerate(COLMAP_PARAMETERS)).get(kind, f"{kind}")
    count = len(COLMAP_PARAMETERS.get(model, "").split())
    return key, model, *size, *_numbers(stream, f"{count}d")


def _stored_image(stream: BinaryIO) -> Sequence[Any]:
    numbers = _numbers(stream, "I7dI")
    name = b""
    while byte := stream.read(1).strip(b"\0"):
        name += byte
        require_at_most(len(name), "cell_characters", "characters of a name")
    (points,) = _numbers(stream, "Q")
    require_at_most(points, "numbers", "observations of an image")
    stream.seek(24 * points, 1)
    return *numbers, name.decode(errors="replace")


def _image_folder(root: Path, folder: Path, names: list[str]) -> Path:
    beside = (parent / "images" for parent in folder.resolve().parents[:3])
    places = (root / "images", root, *beside)
    return max(
        places, key=lambda place: sum((place / name).is_file() for name in names)
    )
