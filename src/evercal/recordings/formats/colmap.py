"""COLMAP models (Schönberger and Frahm, CVPR 2016), read by pycolmap (extra `colmap`).

COLMAP states camera_from_world, and its pixel (0.5, 0.5) is the centre of the top-left pixel, which
is (0, 0) here. It ignores the EXIF orientation. Images without a pose count as untracked, including
files beside the images of the model. Of several models in one folder, the one with the most images
is read.
"""

from pathlib import Path
from typing import Any

import numpy as np

from evercal.errors import InputError, optional_module
from evercal.geometry import SE3, Camera
from evercal.geometry.camera import COEFFICIENTS
from evercal.processes import status_of
from evercal.recordings.cameras.radial_models import RADIAL_MODELS, nearest_fisheye
from evercal.recordings.formats.nerfstudio import frame_note
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import as_stored, files_in
from evercal.recordings.read_options import ReadOptions
from evercal.storage.text_files import (
    library_errors,
    named_errors,
    natural_key,
    path_inside,
)

_MODEL_FOLDERS = (".", "sparse", "colmap/sparse", "distorted/sparse")
"""Usual places of models; distorted/sparse is before undistortion."""
_SUPPORTED = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
    "FOV",
    "EUCM",
)
"""Camera models of which each parameter is OpenCV's, or that are `RADIAL_MODELS`."""
_READ = "import pycolmap, sys; print(flush=True); pycolmap.Reconstruction(sys.argv[1])"
"""Program that ends once a model is read."""
_LEAST_S = 1.0
"""Time for reading an empty binary model, seconds."""
_SLOWEST_BYTES_PER_S = 5e6
"""Bytes of a binary model that are read in a second, at least."""


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
    folder = max(models, key=lambda folder: models[folder].num_reg_images())
    model = models[folder]
    notes = [frame_note("COLMAP", options.metres)]
    if len(models) > 1:
        sizes = [
            f"{path.name}: {part.num_reg_images()}" for path, part in models.items()
        ]
        notes.append(
            f"took model {folder.name}, the one with the most images ({', '.join(sizes)})"
        )
    cameras = {key: _camera(folder, part) for key, part in model.cameras.items()}
    posed = [image for image in model.images.values() if image.has_pose]
    posed.sort(key=lambda image: natural_key(image.name))
    if not posed:
        raise InputError(
            f"{folder}: no image has a pose; reconstruct with more overlap"
        )
    images = _image_folder(root, folder, [image.name for image in posed])
    frames = []
    for image in posed:
        file = as_stored(images / image.name)
        pose = _pose(folder, image)
        frames.append(Frame(image.name, file, cameras[image.camera_id], pose))
    total = len(model.images)
    if images != root:
        total = max(total, len(files_in(images, glob="**/*")))
    name = root.resolve().name
    lost = total - len(frames)
    return Recording(
        name, tuple(frames), (), lost, notes=tuple(notes), metric=options.metres
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
        models = [folder for folder in folders if _is_model(folder)]
        if models:
            return models
    return []


def _is_model(folder: Path) -> bool:
    for end in (".bin", ".txt"):
        if all((folder / (name + end)).is_file() for name in ("cameras", "images")):
            return True
    return False


def _model(folder: Path) -> Any:
    need = f"{folder}: reading a COLMAP model needs pycolmap"
    pycolmap = optional_module("pycolmap", need, "colmap")
    _require_ends(folder)
    with library_errors(f"{folder}: pycolmap cannot read the model"):
        model = pycolmap.Reconstruction(str(folder))
        names = _names(folder)
        for key, image in model.images.items():
            name = names.get(key, image.name)  # decodes UTF-8
            image.name = path_inside(name, "the name of an image")
        return model


def _names(folder: Path) -> dict[int, str]:
    """Names of the images of a text model, which pycolmap cuts at the first blank."""
    if (folder / "images.bin").is_file():
        return {}
    text = (folder / "images.txt").read_text("utf-8")
    lines = [line for line in text.split("\n") if line[:1] != "#"]
    names = {}
    for line in lines[::2]:
        words = line.split(maxsplit=9)
        if words:
            names[int(words[0])] = words[9]
    return names


def _require_ends(folder: Path) -> None:
    """Refuse binary files that pycolmap would read without end.

    At the end of an incomplete file it goes on with what is left in memory. So a process of its
    own reads the model first.
    """
    sizes = {file: file.stat().st_size for file in sorted(folder.glob("*.bin"))}
    for file, size in sizes.items():
        with file.open("rb") as stream:
            count = int.from_bytes(stream.read(8), "little")
        if size < 8 or count > (size - 8) / 8:  # no entry is shorter
            raise InputError(
                f"{file}: {size} bytes, too few for what it lists; copy it again"
            )
    seconds = _LEAST_S + sum(sizes.values()) / _SLOWEST_BYTES_PER_S
    if sizes and status_of(_READ, str(folder), seconds=seconds) is None:
        raise InputError(
            f"{folder}: pycolmap does not finish reading it; a file is incomplete, copy it again"
        )


def _camera(folder: Path, camera: Any) -> Camera:
    name = camera.model.name
    if name not in _SUPPORTED:
        raise InputError(
            f"{folder}: camera model {name} is not supported, only {', '.join(_SUPPORTED)};"
            f" undistort the images with 'colmap image_undistorter' and read its result"
        )
    names = camera.params_info.split(", ")
    values = dict(zip(names, map(float, camera.params), strict=True))
    values.setdefault("k1", values.get("k", 0.0))  # the only coefficient is called k
    one_focal = values.get("f", 0.0)
    focal = (values.get("fx", one_focal), values.get("fy", one_focal))
    # COLMAP counts from the image's corner.
    centre = (values["cx"] - 0.5, values["cy"] - 0.5)
    size = (int(camera.width), int(camera.height))
    kind = name.lower()
    with named_errors(folder, "COLMAP model"):
        if kind in RADIAL_MODELS:
            parameters = [values[key] for key in RADIAL_MODELS[kind].parameters]
            return nearest_fisheye(kind, parameters, size, focal, centre)
        model = "fisheye" if kind.endswith("fisheye") else "pinhole"
        count = 8 if "k6" in values else 4
        names = COEFFICIENTS[model][:count]
        distortion = tuple(values.get(name, 0.0) for name in names)
        return Camera(*size, *focal, *centre, distortion, model)


def _pose(folder: Path, image: Any) -> SE3:
    camera_from_world: Any = image.cam_from_world
    if callable(camera_from_world):  # a method since pycolmap 3.12
        camera_from_world = camera_from_world()
    with named_errors(folder / image.name, "pose"):
        return SE3.from_matrix(np.asarray(camera_from_world.matrix())).inverse()


def _image_folder(root: Path, folder: Path, names: list[str]) -> Path:
    beside = (parent / "images" for parent in folder.resolve().parents[:3])
    places = (root / "images", root, *beside)
    return max(
        places, key=lambda place: sum((place / name).is_file() for name in names)
    )
