"""Intrinsics from a file: a 3x3 matrix as text, evercal's own JSON, or ROS's camera_info YAML.

    525 0 319.5                  {"width": 640, "height": 480,       image_width: 640
    0 525 239.5                   "fx": 525, "fy": 525,              image_height: 480
    0 0 1                         "cx": 319.5, "cy": 239.5,          camera_matrix: {data: [...]}
                                  "distortion": []}                  distortion_coefficients: ...

The file's content decides which of them it is, not its ending. Of ROS both the calibration file and
a printed message (`ros2 topic echo --once .../camera_info`) are read, the matrix K and D of the raw
image; the projection P of the rectified image is not used. All count pixels from the centre of the
top-left pixel.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path

from evercal.errors import InputError
from evercal.geometry import Camera

_MODELS = ("plumb_bob", "rational_polynomial", "none", "")
_LENGTHS = (0, 4, 5, 8)


def read_camera(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> Camera:
    """Reads the intrinsics of one camera.

    Args:
        path: The file.
        size: (width, height) in pixels of the images that a bare 3x3 matrix belongs to; the other
            kinds say it themselves.

    Raises:
        InputError: The file is missing, is none of the three kinds, or holds no usable camera.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: camera file is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: camera file cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; {_EXPECTED}") from None
    try:
        if text.lstrip().startswith("{"):
            return Camera.from_dict(_json_object(text))
        numbers = _plain_numbers(text)
        if numbers is not None:
            return _from_matrix(numbers, size)
        return camera_from_ros(_yaml_mapping(text))
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: {error}") from None


_EXPECTED = "give a 3x3 matrix as text, evercal's camera JSON or a ROS camera_info YAML"


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
    lens = data.get("distortion_coefficients", data.get("D", data.get("d", [])))
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
