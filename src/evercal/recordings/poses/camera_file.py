"""Camera files: a 3x3 matrix, JSON, YAML, NPZ, ROS camera_info, OpenCV's FileStorage.

The content decides the kind, not the file ending; docs/formats.md lists the names of the fields. Of
ROS, both calibration files and printed messages are read, with the matrix K and D of the raw image.
In all kinds, pixel (0, 0) is the centre of the top-left pixel, and images are upright.
"""

import json
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.poses.row_files import arrays_as_lists, is_number
from evercal.recordings.text_files import named_errors, read_text, yaml_documents

_MODELS = (
    "plumbbob", "rationalpolynomial", "brownconrady", "radtan", "opencv", "pinhole", "none", "",
)  # fmt: skip
_MODEL_KEYS = ("distortionmodel", "model", "cameramodel")
_LENGTHS = (0, 4, 5, 8)
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# Names of the fields in lower case without underscores.
_ALIASES = {
    "camera_matrix": ("cameramatrix", "intrinsicmatrix", "intrinsics", "k", "mtx"),
    "distortion_coefficients": (
        "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "distortion",
        "dist", "coeffs", "d",
    ),
    "image_width": ("imagewidth", "width", "w"),
    "image_height": ("imageheight", "height", "h"),
    "image_size": ("imagesize", "imgsize", "resolution", "size"),
    "fx": ("fx",),
    "fy": ("fy",),
    "cx": ("cx", "ppx"),
    "cy": ("cy", "ppy"),
}  # fmt: skip
_ROS = ("distortionmodel", "rectificationmatrix", "projectionmatrix", "header", "roi", "p", "r")
_EXPECTED = (
    "give a 3x3 matrix as text, JSON, YAML or NPZ with camera_matrix and dist_coeffs, a ROS"
    " camera_info or OpenCV's storage"
)


def read_camera(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> Camera:
    """Read the intrinsics of one camera.

    `size` is (width, height) of the images in pixels, for files without one.
    """
    path = Path(path)
    with named_errors(path, "camera file"):
        return camera_from_fields(_fields_of(path), size)


def read_camera_of_size(path: Path, size: tuple[int, int], images: str) -> Camera:
    """Read the intrinsics of images of one size; another size is refused."""
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


def camera_from_fields(data: Mapping[str, Any], size: tuple[int, int] | None = None) -> Camera:
    """Build a camera from the fields of a file, or of a ROS message.

    `size` is (width, height) in pixels of the images, if the fields may lack it. ValueError: the
    fields are no camera, or the images are distorted otherwise or cut out.
    """
    fields, ros = _fields(data), not {_plain(key) for key in data}.isdisjoint(_ROS)
    roi = data.get("roi")
    if isinstance(roi, dict) and any(roi.get(key) for key in ("x_offset", "y_offset")):
        raise ValueError(f"the image is a cut-out (roi {roi}); give the whole image's camera_info")
    if fields.get("fisheyemodel"):
        raise ValueError("fisheye_model is set; rectify the images or calibrate without it")
    matrix = _matrix(fields, data)
    width, height = _size(fields, data, None if ros else size)
    distortion = _distortion(fields, data, ros)
    for model in (str(fields[key]) for key in _MODEL_KEYS if key in fields):
        # RealSense prints distortion.inverse_brown_conrady, mostly with zeros.
        known = _plain(model.rpartition(".")[2].replace(" ", "")) in _MODELS
        if not known and (any(distortion) or "conrady" not in model.lower()):
            raise ValueError(
                f"distortion_model {model!r} is not supported; rectify the images or calibrate with"
                f" plumb_bob or rational_polynomial"
            )
    return Camera.from_matrix(matrix, width, height, tuple(distortion))


def _fields_of(path: Path) -> Mapping[str, Any]:
    with path.open("rb") as file:
        zipped = file.read(2) == b"PK"
    if zipped:
        return arrays_as_lists(path)
    text = read_text(path, "camera file")
    if "<opencv_storage" in text:
        return _xml_of_opencv(text)
    words = re.sub(r"#.*|[,;\[\]]", " ", text).split()
    if all(map(is_number, words)):
        return {"camera_matrix": [float(word) for word in words]}
    try:
        if text.lstrip().startswith("{"):
            return json.loads(text)
        # OpenCV's %YAML:1.0 is not valid YAML. cv2.FileStorage can end the process on such files.
        plain = re.sub(r"^%.*$|!!opencv-[a-z-]+", "", text, flags=re.MULTILINE)
        # A printed message ends with '---', which opens a second, empty document.
        data = next(iter(yaml_documents(plain)), None)
    except json.JSONDecodeError as error:
        raise ValueError(f"not valid JSON ({error}); {_EXPECTED}") from None
    except ValueError as error:
        raise ValueError(f"{error}; {_EXPECTED}") from None
    if not isinstance(data, dict):
        raise ValueError(f"no camera in it; {_EXPECTED}")
    return data


def _xml_of_opencv(text: str) -> dict[str, Any]:
    from xml.etree import ElementTree

    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities can expand without bound
        raise ValueError(f"it declares XML entities; {_EXPECTED}")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML ({error}); {_EXPECTED}") from None
    found: dict[str, Any] = {}
    for element in root:
        data, word = element.find("data"), element.text or ""
        if data is not None:
            found[element.tag] = {"data": (data.text or "").split()}
        elif is_number(word):
            found[element.tag] = float(word)
    return found


def _plain(key: object) -> str:
    return str(key).lower().replace("_", "")


def _fields(data: Mapping[str, Any]) -> dict[str, Any]:
    keys: dict[str, str] = {}
    for key in data:
        plain = _plain(key)
        name = next((name for name, aliases in _ALIASES.items() if plain in aliases), plain)
        if name in keys and name in (*_ALIASES, *_COEFFICIENTS):
            raise ValueError(f"{keys[name]} and {key} are the same; keep one of them")
        keys[name] = key
    return {name: data[key] for name, key in keys.items()}


def _matrix(fields: Mapping[str, Any], data: Mapping[str, Any]) -> np.ndarray:
    if "camera_matrix" in fields:
        matrix = np.reshape(_numbers(fields["camera_matrix"], "camera_matrix", 9), (3, 3))
        # Open3D writes it column after column.
        return matrix.T if not matrix[:2, 2].any() and matrix[2, :2].any() else matrix
    names = ("fx", "fy", "cx", "cy")
    missing = [name for name in names if name not in fields]
    if missing:
        what = f"camera {missing[0]!r}" if len(missing) < 4 else "'camera_matrix'"
        raise ValueError(f"{what} is missing, there is {_listed(data) or 'nothing'}; {_EXPECTED}")
    fx, fy, cx, cy = _numbers([fields[name] for name in names], "fx, fy, cx, cy", 4)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _distortion(fields: Mapping[str, Any], data: Mapping[str, Any], ros: bool) -> list[float]:
    name = "distortion_coefficients"
    stated = [key for key in _COEFFICIENTS if key in fields]
    if name in fields:
        numbers = _numbers(fields[name], name)
    elif stated:
        numbers = _numbers([fields.get(key, 0.0) for key in _COEFFICIENTS], stated[0])
        numbers = numbers if any(numbers[5:]) else numbers[:5]
    else:
        other = [key for key in data if "dist" in _plain(key) and _plain(key) not in _MODEL_KEYS]
        if ros or other:
            raise ValueError(
                f"{name!r} is missing, there is {_listed(other or data)}; write four zeros if"
                f" images have no lens distortion"
            )
        numbers = []
    # Longer models add terms that are mostly zero and can then be dropped.
    while len(numbers) not in _LENGTHS and numbers[-1] == 0:
        numbers.pop()
    return numbers


def _size(
    fields: Mapping[str, Any], data: Mapping[str, Any], size: tuple[int, int] | None
) -> tuple[Any, Any]:
    missing = [name for name in ("image_width", "image_height") if name not in fields]
    stated = fields.get("image_size")
    if not missing:
        stated = [fields["image_width"], fields["image_height"]]
    elif isinstance(stated, Mapping):
        return _size(_fields(stated), stated, None)
    elif not isinstance(stated, list | tuple):  # a number called `size` is not one
        stated = size if len(missing) == 2 else None
    if stated is None:
        raise ValueError(f"{missing[0]!r} is missing (no image size), there is {_listed(data)}")
    width, height = _numbers(list(stated), "image size (width, height)", 2)
    return width, height


def _listed(keys: Iterable[object]) -> str:
    return ", ".join(map(str, keys))


def _numbers(value: Any, name: str, count: int | None = None) -> list[float]:
    value = value.get("data") if isinstance(value, dict) else value
    try:
        if not isinstance(value, list) or any(isinstance(v, bool) for v in value):
            raise TypeError
        # YAML 1.1 reads 1e-05, as written by ROS, as a word.
        numbers = np.array(value, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError):
        raise ValueError(f"'{name}' is a list of numbers, got {value!r}") from None
    if count is not None and len(numbers) != count:
        raise ValueError(f"{name} has {count} numbers, got {len(numbers)}; {_EXPECTED}")
    return numbers
