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

USES = ("metres",)

_MODEL_FOLDERS = (".", "sparse", "colmap/sparse", "distorted/sparse")
# Models of which each parameter is OpenCV's, or one of `RADIAL_MODELS`.
_SUPPORTED = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV",
    "SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE",
    "FOV", "EUCM",
)  # fmt: skip
_READ = "import pycolmap, sys; print(flush=True); pycolmap.Reconstruction(sys.argv[1])"
_LEAST_S, _SLOWEST_BYTES_PER_S = 1.0, 5e6
"""Time for reading a binary model."""


def detect(root: Path) -> bool:
    """Whether `root` is or holds a model."""
    return bool(_models(root))


def load(root: Path, options: ReadOptions | None = None) -> Recording:
    """Read the largest model; no image is opened whole."""
    metric = options is not None and options.metres
    models = {folder: _model(folder) for folder in _models(root)}
    if not models:
        raise InputError(
            f"{root}: no COLMAP model; expected cameras and images (.bin or .txt)"
        )
    folder = max(models, key=lambda folder: models[folder].num_reg_images())
    model = models[folder]
    notes = [frame_note("COLMAP", metric)]
    if len(models) > 1:
        sizes = ", ".join(f"{f.name}: {m.num_reg_images()}" for f, m in models.items())
        notes.append(
            f"took model {folder.name}, the one with the most images ({sizes})"
        )
    cameras = {key: _camera(folder, camera) for key, camera in model.cameras.items()}
    posed = [image for image in model.images.values() if image.has_pose]
    posed.sort(key=lambda image: natural_key(image.name))
    if not posed:
        raise InputError(
            f"{folder}: no image has a pose; reconstruct with more overlap"
        )
    images = _image_folder(root, folder, [image.name for image in posed])
    frames = [
        Frame(
            i.name, as_stored(images / i.name), cameras[i.camera_id], _pose(folder, i)
        )
        for i in posed
    ]
    files = files_in(images, glob="**/*")
    total = max(len(model.images), len(files) if images != root else 0)
    name = root.resolve().name
    lost = total - len(frames)
    return Recording(name, tuple(frames), (), lost, notes=tuple(notes), metric=metric)


def _models(root: Path) -> list[Path]:
    """Model folders in the first of the usual places; distorted/sparse is before undistortion."""
    for name in _MODEL_FOLDERS:
        parent = root / name
        inner = sorted(parent.iterdir()) if parent.is_dir() else []
        if name == ".":  # may be a folder of models, which COLMAP numbers
            inner = [folder for folder in inner if folder.name.isdigit()]
        if models := [folder for folder in (parent, *inner) if _is_model(folder)]:
            return models
    return []


def _is_model(folder: Path) -> bool:
    names = ("cameras", "images")
    kinds = [
        all((folder / (name + end)).is_file() for name in names)
        for end in (".bin", ".txt")
    ]
    return any(kinds)


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
    return {int(w[0]): w[9] for line in lines[::2] if (w := line.split(maxsplit=9))}


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
    names = camera.params_info.split(", ")  # the only coefficient is called k
    names = ["k1" if name == "k" else name for name in names]
    named = dict(zip(names, map(float, camera.params), strict=True))
    focal = named.get("fx", named.get("f", 0.0)), named.get("fy", named.get("f", 0.0))
    # COLMAP counts from the image's corner.
    centre = (
        named["cx"] - 0.5,
        named["cy"] - 0.5,
    )
    size = (int(camera.width), int(camera.height))
    kind = name.lower()
    with named_errors(folder, "COLMAP model"):
        if kind in RADIAL_MODELS:
            own = [named[key] for key in RADIAL_MODELS[kind].parameters]
            return nearest_fisheye(kind, own, size, focal, centre)
        model = "fisheye" if kind.endswith("fisheye") else "pinhole"
        count = 8 if "k6" in named else 4 if "k1" in named else 0
        distortion = tuple(named.get(key, 0.0) for key in COEFFICIENTS[model][:count])
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
