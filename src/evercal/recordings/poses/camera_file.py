"""Camera files: 3x3 matrix as text, evercal's JSON, ROS camera_info, OpenCV's FileStorage.

The content decides the kind, not the file ending. Both ROS calibration files and printed messages
(`ros2 topic echo --once .../camera_info`) are read, with the matrix K and D of the raw image. In
all kinds, pixel (0, 0) is the centre of the top-left pixel, and images are upright.
"""

import os
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.poses.row_files import is_number
from evercal.recordings.text_files import read_json, read_text

_MODELS = ("plumb_bob", "rational_polynomial", "none", "")
_LENGTHS = (0, 4, 5, 8)
# Names of the fields in lower case without underscores.
_ALIASES = {
    "camera_matrix": ("cameramatrix", "intrinsicmatrix", "k"),
    "distortion_coefficients": ("distortioncoefficients", "distcoeffs", "distcoeff", "d"),
    "image_width": ("imagewidth", "width"),
    "image_height": ("imageheight", "height"),
}


def read_camera(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> Camera:
    """Read the intrinsics of one camera.

    `size` is (width, height) in pixels of the images. A 3x3 matrix and OpenCV's storage without a
    size need it; otherwise the size in the file is used.

    Raises:
        InputError: The file is missing, of an unknown kind, or holds no usable camera.
    """
    import yaml

    path = Path(path)
    text = read_text(path, "camera file")
    try:
        if text.lstrip().startswith("{"):
            return Camera.from_dict(read_json(path, "camera file", _EXPECTED))
        if text.startswith("%YAML:") or "opencv-matrix" in text or "<opencv_storage" in text:
            return camera_from_ros(_stored_by_opencv(text, size))
        words = re.sub(r"#.*|,", " ", text).split()
        if all(map(is_number, words)):
            if len(words) != 9:
                raise ValueError(f"{len(words)} numbers, a 3x3 matrix has 9; {_EXPECTED}")
            if size is None:
                raise ValueError("a 3x3 matrix has no image size; give another kind of camera file")
            return Camera.from_matrix(np.array(words, dtype=float).reshape(3, 3), *size)
        # A printed message ends with '---', which opens a second, empty document.
        data = next(yaml.safe_load_all(text), None)
        if not isinstance(data, dict):
            raise ValueError(f"no camera in it; {_EXPECTED}")
        return camera_from_ros(data)
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not valid YAML ({reason}); {_EXPECTED}") from None
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: {error}") from None


def read_camera_of_size(path: Path, size: tuple[int, int], images: str) -> Camera:
    """Read the intrinsics of images of one size.

    Raises:
        InputError: As `read_camera`, or the camera has another size.
    """
    camera = read_camera(path, size)
    check_size(str(path), camera, size, images)
    return camera


def check_size(source: str, camera: Camera, size: tuple[int, int], images: str) -> None:
    """Raise `InputError` if a camera from `source` has another size than its images."""
    if (camera.width, camera.height) != size:
        raise InputError(
            f"{source}: is for images of {camera.width}x{camera.height}, {images} is"
            f" {size[0]}x{size[1]}; give the intrinsics of this image size with --camera"
        )


_EXPECTED = (
    "give a 3x3 matrix as text, evercal's camera JSON, a ROS camera_info YAML or OpenCV's storage"
)


def _stored_by_opencv(text: str, size: tuple[int, int] | None) -> dict[str, object]:
    """Values of a cv2.FileStorage."""
    import cv2

    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = {key: storage.getNode(key) for key in storage.root().keys()}  # noqa: SIM118
        values: dict[str, object] = {
            key: node.mat().ravel().tolist() if node.isMap() else node.real()
            for key, node in nodes.items()
            if node.isMap() or node.isInt() or node.isReal()
        }
    except (cv2.error, SystemError, AttributeError) as error:
        text = " ".join(str(error).split())[:100]
        raise ValueError(f"OpenCV cannot read its storage ({text}); {_EXPECTED}") from None
    if values.get("fisheye_model"):
        raise ValueError("fisheye_model is set; rectify the images or calibrate without it")
    if size is not None and not {"image_width", "image_height"} & _fields(values).keys():
        values |= {"image_width": size[0], "image_height": size[1]}
    return values


def _fields(data: Mapping[str, object]) -> dict[str, object]:
    """Known fields under their names in a ROS calibration file."""
    fields: dict[str, object] = {}
    for name, aliases in _ALIASES.items():
        keys = [key for key in data if str(key).lower().replace("_", "") in aliases]
        if len(keys) > 1:
            raise ValueError(f"{' and '.join(keys)} are the same; keep one of them")
        if keys:
            fields[name] = data[keys[0]]
    return fields


def camera_from_ros(data: Mapping[str, object]) -> Camera:
    """Build the camera of the raw image from the fields of a camera_info or a calibration file.

    Raises:
        ValueError: A field is missing or unusable, the distortion model is not supported, or the
            image is a region of interest.
    """
    fields = _fields(data)
    for name in _ALIASES:
        if name not in fields:
            zeros = "; write four zeros if images have no lens distortion"
            remedy = zeros if name == "distortion_coefficients" else f"; {_EXPECTED}"
            names = ", ".join(map(str, data)) or "nothing"
            raise ValueError(f"'{name}' is missing, there is {names}{remedy}")
    matrix, distortion = (_list(fields[name], name) for name in [*_ALIASES][:2])
    model = data.get("distortion_model", "")
    if model not in _MODELS:
        raise ValueError(
            f"distortion_model {model!r} is not supported; rectify the images or calibrate with"
            f" plumb_bob or rational_polynomial"
        )
    if len(matrix) != 9:
        raise ValueError(f"camera_matrix has 9 numbers, got {len(matrix)}")
    roi = data.get("roi")
    if isinstance(roi, dict) and any(roi.get(key) for key in ("x_offset", "y_offset")):
        raise ValueError(f"the image is a cut-out (roi {roi}); give the whole image's camera_info")
    # Longer models add terms that are mostly zero and can then be dropped.
    while len(distortion) not in _LENGTHS and distortion[-1] == 0:
        distortion.pop()
    width, height = _list([fields["image_width"], fields["image_height"]], "image size")
    return Camera.from_matrix(
        [matrix[:3], matrix[3:6], matrix[6:]],
        width,  # pyright: ignore[reportArgumentType]  # checked when constructed
        height,  # pyright: ignore[reportArgumentType]
        tuple(distortion),
    )


def _list(value: object, name: str) -> list[float]:
    """Numbers from a list or from OpenCV's {rows, cols, data}."""
    value = value.get("data") if isinstance(value, dict) else value
    try:
        if not isinstance(value, list) or any(isinstance(v, bool) for v in value):
            raise TypeError
        # YAML 1.1 reads 1e-05, as written by ROS, as a word.
        return [float(v) for v in value]
    except (TypeError, ValueError):
        raise ValueError(f"'{name}' is a list of numbers, got {value!r}") from None
