"""Intrinsics from a file: 3x3 matrix as text, evercal's JSON, ROS's camera_info, OpenCV's storage.

    525 0 319.5                  {"width": 640, "height": 480,       image_width: 640
    0 525 239.5                   "fx": 525, "fy": 525,              image_height: 480
    0 0 1                         "cx": 319.5, "cy": 239.5,          camera_matrix: {data: [...]}
                                  "distortion": []}                  distortion_coefficients: ...

The file's content decides which of them it is, not its ending. Of ROS both the calibration file and
a printed message (`ros2 topic echo --once .../camera_info`) are read, the matrix K and D of the raw
image; the projection P of the rectified image is not used. What OpenCV's FileStorage writes (YAML
that starts with %YAML:1.0, or XML) holds camera_matrix and distortion_coefficients too. All count
pixels from the centre of the top-left pixel.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path

from evercal.errors import InputError
from evercal.geometry import Camera

_MODELS = ("plumb_bob", "rational_polynomial", "none", "")
_LENGTHS = (0, 4, 5, 8)
# What programs that write OpenCV's storage call the fields, in lower case without underscores.
_CALLED = {
    "camera_matrix": ("cameramatrix", "intrinsicmatrix", "k"),
    "distortion_coefficients": ("distortioncoefficients", "distcoeffs", "distcoeff", "d"),
    "image_width": ("imagewidth", "width"),
    "image_height": ("imageheight", "height"),
}


def read_camera(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> Camera:
    """Reads the intrinsics of one camera.

    Args:
        path: The file.
        size: (width, height) in pixels of the images that a bare 3x3 matrix belongs to, or
            OpenCV's storage without a size; the other kinds say it themselves.

    Raises:
        InputError: The file is missing, is none of these kinds, or holds no usable camera.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: camera file is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: camera file cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; {_EXPECTED}") from None
    try:
        if text.lstrip().startswith("{"):
            return Camera.from_dict(_json_object(text))
        if text.startswith("%YAML:") or "opencv-matrix" in text or "<opencv_storage" in text:
            return camera_from_ros(_stored_by_opencv(text, size))
        numbers = _plain_numbers(text)
        if numbers is not None:
            return _from_matrix(numbers, size)
        return camera_from_ros(_yaml_mapping(text))
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: {error}") from None


_EXPECTED = (
    "give a 3x3 matrix as text, evercal's camera JSON, a ROS camera_info YAML or OpenCV's storage"
)


def _json_object(text: str) -> Mapping[str, object]:
    try:
        data = json.loads(text)
    except ValueError as error:
        raise ValueError(f"not valid JSON ({error}); {_EXPECTED}") from None
    return data


def _plain_numbers(text: str) -> list[float] | None:
    """All words as numbers, without commas and comments; None if a word is none."""
    lines = (line.split("#")[0].replace(",", " ") for line in text.splitlines())
    try:
        return [float(word) for line in lines for word in line.split()]
    except ValueError:
        return None


def _from_matrix(numbers: list[float], size: tuple[int, int] | None) -> Camera:
    if len(numbers) != 9:
        raise ValueError(f"{len(numbers)} numbers, a 3x3 matrix has 9; {_EXPECTED}")
    if size is None:
        raise ValueError("a 3x3 matrix does not tell the image size it is for; give it as well")
    return Camera.from_matrix([numbers[:3], numbers[3:6], numbers[6:]], *size)


def _yaml_mapping(text: str) -> Mapping[str, object]:
    import yaml

    try:
        # A printed message ends with '---', which opens a second, empty document.
        data = next(yaml.safe_load_all(text), None)
    except yaml.YAMLError as error:
        raise ValueError(f"not valid YAML ({' '.join(str(error).split())}); {_EXPECTED}") from None
    if not isinstance(data, dict):
        raise ValueError(f"no camera in it; {_EXPECTED}")
    return data


def _stored_by_opencv(text: str, size: tuple[int, int] | None) -> dict[str, object]:
    """The fields of a cv2.FileStorage, by ROS's names."""
    import cv2

    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = {key: storage.getNode(key) for key in storage.root().keys()}  # noqa: SIM118
        values = {
            key: node.mat().ravel().tolist() if node.isMap() else node.real()
            for key, node in nodes.items()
            if node.isMap() or node.isInt() or node.isReal()
        }
    except (cv2.error, SystemError, AttributeError) as error:
        text = " ".join(str(error).split())[:100]
        raise ValueError(f"OpenCV cannot read its storage ({text}); {_EXPECTED}") from None
    if values.get("fisheye_model"):
        raise ValueError("fisheye_model is set; rectify the images or calibrate without it")
    found: dict[str, object] = {}
    for name, called in _CALLED.items():
        keys = [key for key in values if key.lower().replace("_", "") in called]
        if len(keys) > 1:
            raise ValueError(f"{' and '.join(keys)} are the same; keep one of them")
        if keys:
            found[name] = values[keys[0]]
    if "camera_matrix" not in found:
        raise ValueError(f"'camera_matrix' is missing, there is {', '.join(nodes) or 'nothing'}")
    if size is not None and not {"image_width", "image_height"} & found.keys():
        found |= {"image_width": size[0], "image_height": size[1]}
    return found


def camera_from_ros(data: Mapping[str, object]) -> Camera:
    """The raw image's camera of a camera_info message, by the names of its fields.

    Args:
        data: `width`, `height`, `k`, `d`, `distortion_model` and `roi` of a message, or the names
            of a calibration file.

    Raises:
        ValueError: A field is missing or unusable; a lens that is not supported; a cut-out image.
    """
    width = _first(data, "image_width", "width")
    height = _first(data, "image_height", "height")
    matrix = _list(_first(data, "camera_matrix", "K", "k"), "camera_matrix")
    lens = next(
        (data[name] for name in ("distortion_coefficients", "D", "d") if name in data), None
    )
    if lens is None:  # it may stand under another name
        raise ValueError(
            f"'distortion_coefficients' is missing, there is {', '.join(map(str, data))}; write"
            f" four zeros if images have no lens distortion"
        )
    distortion = _list(lens, "distortion_coefficients")
    model = data.get("distortion_model", "")
    if model not in _MODELS:
        raise ValueError(
            f"distortion_model {model!r} is not supported; rectify the images or calibrate with"
            f" plumb_bob or rational_polynomial"
        )
    if len(matrix) != 9:
        raise ValueError(f"camera_matrix has 9 numbers, got {len(matrix)}")
    _refuse_cropped(data.get("roi"))
    # Longer models add terms that are mostly zero; only then nothing is lost without them.
    while len(distortion) not in _LENGTHS and distortion[-1] == 0:
        distortion.pop()
    sides = _list([width, height], "image size")
    return Camera.from_matrix(
        [matrix[:3], matrix[3:6], matrix[6:]],
        sides[0],  # pyright: ignore[reportArgumentType]  # checked when constructed
        sides[1],  # pyright: ignore[reportArgumentType]
        tuple(distortion),
    )


def _first(data: Mapping[str, object], *names: str) -> object:
    for name in names:
        if name in data:
            return data[name]
    raise ValueError(f"'{names[0]}' is missing; {_EXPECTED}")


def _list(value: object, name: str) -> list[float]:
    """Numbers from a list or from OpenCV's {rows, cols, data}."""
    value = value.get("data") if isinstance(value, dict) else value
    try:
        if not isinstance(value, list) or any(isinstance(v, bool) for v in value):
            raise TypeError
        # YAML 1.1 reads 1e-05, as ROS writes it, as a word.
        return [float(v) for v in value]
    except (TypeError, ValueError):
        raise ValueError(f"'{name}' is a list of numbers, got {value!r}") from None


def _refuse_cropped(roi: object) -> None:
    if isinstance(roi, dict) and any(roi.get(key) for key in ("x_offset", "y_offset")):
        raise ValueError(f"the image is a cut-out (roi {roi}); give the whole image's camera_info")
