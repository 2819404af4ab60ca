"""A COLMAP model (Schönberger and Frahm, CVPR 2016), read by pycolmap (extra `colmap`).

    ROOT/sparse/0/cameras.bin, images.bin, points3D.bin    or .txt, or ROOT itself, or ROOT/0
    ROOT/images/...

COLMAP states camera_from_world and counts pixels from the image's corner, so that the centre of the
top-left pixel is (0.5, 0.5); here it is (0, 0). The base frame and the unit of length are the
model's own. Images without a pose, and those beside them that the model does not name, count as
untracked. Of several models in one place the one with the most images is taken.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.formats.nerfstudio import NOTE
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import IMAGE_ENDINGS
from evercal.recordings.poses.row_files import natural_key

_MODEL_FOLDERS = (".", "sparse", "colmap/sparse", "distorted/sparse")
# Where COLMAP's parameters stand: focal lengths, principal point, OpenCV's distortion.
_PARAMETERS: dict[str, tuple[int, int, int, int, tuple[int | None, ...]]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2, ()),
    "PINHOLE": (0, 1, 2, 3, ()),
    "SIMPLE_RADIAL": (0, 0, 1, 2, (3, None, None, None)),
    "RADIAL": (0, 0, 1, 2, (3, 4, None, None)),
    "OPENCV": (0, 1, 2, 3, (4, 5, 6, 7)),
    "FULL_OPENCV": (0, 1, 2, 3, (4, 5, 6, 7, 8, 9, 10, 11)),
}


def detect(root: Path) -> bool:
    """Whether `root` is or holds a model."""
    return bool(_models(root))


def load(root: str | os.PathLike[str]) -> Recording:
    """Reads the model and looks for its images; opens none of them.

    Raises:
        InputError: The extra `colmap` is not installed, the model is broken or of a camera that is
            not supported, or its images are missing.
    """
    root = Path(root)
    folder, model, notes = _largest(root)
    cameras = {key: _camera(folder, camera) for key, camera in model.cameras.items()}
    posed = sorted(
        (image for image in model.images.values() if image.has_pose),
        key=lambda image: natural_key(image.name),
    )
    if not posed:
        raise InputError(f"{folder}: no image has a pose; reconstruct with more overlap")
    images = _image_folder(root, folder, [image.name for image in posed])
    frames = tuple(
        Frame(image.name, images / image.name, cameras[image.camera_id], _base_from_camera(image))
        for image in posed
    )
    beside = (
        sum(p.suffix.lower() in IMAGE_ENDINGS for p in images.rglob("*")) if images != root else 0
    )
    lost = max(len(model.images), beside) - len(frames)
    return Recording(
        root.resolve().name, frames, (), lost, notes=(NOTE.format(file="COLMAP"), *notes)
    )


def _models(root: Path) -> list[Path]:
    """Folders with a model in them, all in the first place that has one.

    Models elsewhere are not of the same images: those of distorted/sparse are from before the lens
    was taken out.
    """
    for name in _MODEL_FOLDERS:
        place = root / name
        inner = sorted(place.iterdir()) if place.is_dir() else []
        if name == ".":  # may be a folder of models, which COLMAP numbers
            inner = [folder for folder in inner if folder.name.isdigit()]
        found = [f for f in (place, *inner) if f.is_dir() and _is_model(f)]
        if found:
            return found
    return []


def _is_model(folder: Path) -> bool:
    return any(
        all((folder / f"{name}.{kind}").is_file() for name in ("cameras", "images"))
        for kind in ("bin", "txt")
    )


def _largest(root: Path) -> tuple[Path, Any, list[str]]:
    """The model with the most posed images, and a note if there are others."""
    try:
        import pycolmap  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError(
            f"{root}: reading a COLMAP model needs pycolmap; run: pip install 'evercal[colmap]'"
        ) from None
    folders = _models(root)
    if not folders:
        raise InputError(
            f"{root}: no COLMAP model; expected cameras, images and points3D (.bin, .txt)"
        )
    read = []
    for folder in folders:
        try:
            read.append((folder, pycolmap.Reconstruction(str(folder))))
        except Exception as error:  # pycolmap passes C++ exceptions on as several types
            text = " ".join(str(error).split())[:200]
            raise InputError(f"{folder}: pycolmap cannot read the model: {text}") from None
    folder, model = max(read, key=lambda pair: pair[1].num_reg_images())
    if len(read) == 1:
        return folder, model, []
    sizes = ", ".join(f"{f.name}: {m.num_reg_images()}" for f, m in read)
    return folder, model, [f"took model {folder.name}, the one with the most images ({sizes})"]


def _camera(folder: Path, camera: Any) -> Camera:
    name = camera.model.name
    if name not in _PARAMETERS:
        raise InputError(
            f"{folder}: camera model {name} is not supported, only {', '.join(_PARAMETERS)};"
            f" undistort the images with 'colmap image_undistorter' and read its result"
        )
    fx, fy, cx, cy, lens = _PARAMETERS[name]
    p = np.asarray(camera.params, dtype=np.float64)
    distortion = tuple(0.0 if i is None else float(p[i]) for i in lens)
    try:
        # Half a pixel: COLMAP counts from the image's corner.
        return Camera(
            int(camera.width),
            int(camera.height),
            p[fx],
            p[fy],
            p[cx] - 0.5,
            p[cy] - 0.5,
            distortion if any(distortion) else (),
        )
    except ValueError as error:
        raise InputError(f"{folder}: {error}") from None


def _base_from_camera(image: Any) -> SE3:
    stated: Any = image.cam_from_world
    stated = stated() if callable(stated) else stated  # a method since pycolmap 3.12
    return SE3.from_matrix(np.asarray(stated.matrix())).inverse()


def _image_folder(root: Path, folder: Path, names: list[str]) -> Path:
    """The folder that all images are in."""
    places = [
        root / "images",
        root,
        *(parent / "images" for parent in folder.resolve().parents[:3]),
    ]
    for place in places:
        if all((place / name).is_file() for name in names):
            return place
    missing = next((n for n in names if not (root / "images" / n).is_file()), names[0])
    raise InputError(
        f"{root / 'images' / missing}: missing; put the model's images in {root}/images"
    )
