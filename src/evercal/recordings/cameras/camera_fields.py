"""A camera from named numbers, as programs write them; docs/formats.md lists the names.

Names are compared in lower case without underscores. Of ROS, the matrix K and D of the raw image
are used. Pixel (0, 0) is the centre of the top-left pixel, and images are upright.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from evercal.geometry import Camera
from evercal.geometry.camera import COEFFICIENT_COUNTS, COEFFICIENTS
from evercal.recordings.cameras.camera_names import (
    CAMERA_INFO,
    DISTORTION,
    FIELDS,
    LENS,
    MODEL_NAMES,
    field_name,
    is_array,
    is_harmless,
    plain_name,
)
from evercal.recordings.cameras.camera_notations import EXPECTED
from evercal.recordings.cameras.field_of_view import (
    VIEW_NAMES,
    has_view,
    pixels_of_view,
)
from evercal.recordings.cameras.radial_models import RADIAL_MODELS, nearest_fisheye
from evercal.recordings.poses.row_files import by_alias, is_number
from evercal.storage.text_files import few
from evercal.typing import Array, Floats, JsonObject, Record, Size, Strings

_MODELS = {"": "brown"} | by_alias("""
brown: brown plumbbob rationalpolynomial
brown: brownconrady radtan radialtangential
brown: opencv fullopencv opencv4 opencv5 opencv8 opencv12
brown: pinhole perspective rectified 0
brown: simplepinhole simpleradial radial
brown: pinholeradialtangential pinholeradtan8
none: none null
fisheye: fisheye opencvfisheye simplefisheye
fisheye: radialfisheye simpleradialfisheye
fisheye: equidistant equi
fisheye: kannalabrandt kannalabrandt4 kannalabrandt8 kb4 1
fov: fov atan
omni: omni
ucm: ucm
eucm: eucm extendedunified
ds: ds doublesphere
division: divisionundistortion
""")
"""Kinds of distortion by names of models, without spaces, dashes and underscores."""
_PINHOLE = COEFFICIENTS["pinhole"]
_OF_ROS = {"rectificationmatrix", "header"}
"""Names of fields that only ROS writes."""
_KNOWN = {
    *FIELDS,
    *MODEL_NAMES,
    *CAMERA_INFO,
    "binningx",
    "binningy",
    "fisheyemodel",
}
"""Names of fields that are used, or that may be left out."""
CENTRAL = 0.05
"""Largest distance of a usual principal point from the middle, widths and heights."""
_PROJECTION = re.compile(r"(.*\.)?(p\d*|prect\d*|proj.*)$")
"""Names of projection matrices, which are for rectified images."""


def named_fields(data: Record) -> JsonObject:
    """Values by `field_name`; ValueError if two keys are the same field."""
    keys = {}
    fields = {}
    for key, value in data.items():
        name = field_name(key)
        if name == "distortion_coefficients" and isinstance(value, str):
            name = "distortionmodel"  # as RealSense prints it
        elif name in _PINHOLE and is_array(value):
            continue  # P1 and P2 of a stereo camera
        if name in keys and name in FIELDS:
            raise ValueError(f"{keys[name]} and {key} are the same; keep one of them")
        keys[name] = key
        fields[name] = value
    return fields


def camera_of(data: Record, size: Size | None) -> Camera:
    """One camera from its fields.

    `size` is (width, height) in pixels of images, for fields without a size. ValueError: they are
    no camera, or the images are cut out or distorted otherwise.
    """
    fields = named_fields(data)
    for key, value in data.items():
        if key.startswith("roi.") and key.endswith("offset") and value:
            raise ValueError(
                f"the image is a cut-out ({key} {value}); give the whole image's camera_info"
            )
    is_ros = not _OF_ROS.isdisjoint(map(plain_name, data))
    if "lensmodel" in fields:  # of mrcal
        numbers = numbers_of(fields.get("camera_matrix"), "intrinsics")
        fields["camera_matrix"] = numbers[:4]
        fields["distortion_coefficients"] = numbers[4:]
    unknown = dict(data)
    if "camera_matrix" not in fields and "fx" not in fields and has_view(fields):
        fields = pixels_of_view(fields, _size(fields, data, size))
        unknown = {key: data[key] for key in data if field_name(key) not in VIEW_NAMES}
    models: JsonObject = {}
    for name in MODEL_NAMES:
        word = fields.get(name)
        kind = _model_kind(word)
        # Numbers are models in files of DepthAI only, and a type may be that of other things.
        other = isinstance(word, int | float) and "lensposition" not in fields
        if name in fields and not other and (kind or name != "type"):
            models[kind] = word
    for kind, parameters in RADIAL_MODELS.items():
        if kind in models:
            camera = _of_radial_model(kind, fields, _size(fields, data, size))
            _refuse_unknown(unknown, parameters)
            return camera
    model = "pinhole"
    if "fisheye" in models or fields.get("fisheyemodel"):
        model = "fisheye"
    distortion = _distortion(fields, model)
    if distortion is None:
        optional = not is_ros and model == "pinhole" and "distortionmodel" not in fields
        if not optional and "none" not in models:
            raise ValueError(
                f"'distortion_coefficients' is missing, there is {_keys(data)}; write four zeros"
                f" if images have no lens distortion"
            )
        distortion = ()
    _refuse_other_models(models, distortion)
    matrix = _matrix(fields, data)
    width, height = _size(fields, data, None if is_ros else size)
    _refuse_unknown(unknown)
    camera = Camera.from_matrix(matrix, width, height)
    camera = replace(camera, distortion=distortion, model=model)
    if size != camera.size:
        camera = _binned(camera, fields)
    return camera


def _model_kind(model: object) -> str:
    """A value of `_MODELS`; `zero` for models that are read without distortion only, else empty."""
    _, _, name = str(model).rpartition(".")
    plain = re.sub(r"[\s_-]", "", name.lower()).removeprefix("lensmodel")
    kind = _MODELS.get(plain, "")
    if not kind and "conrady" in plain:
        # RealSense prints distortion.inverse_brown_conrady, mostly with zeros.
        return "zero"
    return kind


def _of_radial_model(kind: str, fields: Record, size: tuple[Any, Any]) -> Camera:
    """As Kalibr states it: parameters before the focal lengths, or the one of `fov` after them."""
    names = (*RADIAL_MODELS[kind], "fx", "fy", "cx", "cy")
    if "fx" in fields:
        numbers = numbers_of([fields.get(name) for name in names], ", ".join(names))
    else:
        numbers = numbers_of(fields.get("camera_matrix"), "intrinsics")
    distortion = []
    for name in DISTORTION:
        if fields.get(name):
            own = fields[name] if is_array(fields[name]) else [fields[name]]
            distortion += numbers_of(own, name)
    if len(numbers) < len(names):
        numbers = [*distortion, *numbers]
        distortion = []
    if len(numbers) != len(names) or any(distortion):
        expected = f"a camera of model {kind} has {', '.join(names)}"
        raise ValueError(
            f"{expected} and no other distortion, got {numbers} and {distortion}; rectify the"
            f" images or calibrate an equidistant model"
        )
    *parameters, fx, fy, cx, cy = numbers
    if kind == "division":  # stated for pixels
        parameters = [parameters[0] * fx * fx]
    return nearest_fisheye(kind, parameters, size, (fx, fy), (cx, cy))


def _distortion(fields: Record, model: str) -> Floats | None:
    """Coefficients in OpenCV's order; None if there is no field of them."""
    names = COEFFICIENTS[model]
    stated = [name for name in _PINHOLE if fields.get(name)]
    others = [name for name in stated if name not in names]
    if others:
        raise ValueError(
            f"a fisheye has {', '.join(names)}, got {', '.join(others)}; leave others out"
        )
    key = "distortion_coefficients"
    if stated and fields.get(key):
        raise ValueError(f"{key} and {stated[0]} are both stated; keep one of them")
    stated = [name for name in names if name in fields]
    if key in fields:
        if fields[key] is None:
            return ()
        numbers = numbers_of(fields[key], key)
    elif stated:
        numbers = numbers_of([fields.get(name, 0.0) for name in names], stated[0])
        if not any(numbers[5:]):
            numbers = numbers[:5]
    else:
        return None
    # Longer models add terms that are mostly zero and can then be dropped.
    counts = COEFFICIENT_COUNTS[model]
    while len(numbers) not in counts and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


def _refuse_other_models(models: Record, distortion: Floats) -> None:
    """Refuse models other than OpenCV's, which `none` and `zero` are without coefficients."""
    for kind, model in models.items():
        if kind in ("brown", "fisheye"):
            continue
        if not kind or any(distortion):
            raise ValueError(
                f"distortion_model {model!r} is not supported with the coefficients"
                f" {[*distortion]}; rectify the images or calibrate with plumb_bob"
            )


def _matrix(fields: Record, data: Record) -> Array:
    """(3, 3) intrinsic matrix."""
    if "camera_matrix" in fields:
        numbers = numbers_of(fields["camera_matrix"], "camera_matrix")
        # As Kalibr writes it; other orders differ in the first two.
        if len(numbers) == 4 and 0.8 * numbers[1] < numbers[0] < 1.25 * numbers[1]:
            return _matrix_of(*numbers)
        last = [0, 0, 0, 1]
        if len(numbers) == 16 and numbers[12:] == last and numbers[3::4] == last:
            numbers = np.reshape(numbers, (4, 4))[:3, :3].ravel().tolist()
        numbers = numbers_of(numbers, "camera_matrix", 9)
        matrix = np.reshape(numbers, (3, 3))
        if matrix[2, :2].any() and not matrix[:2, 2].any():
            return matrix.T  # Open3D writes it column after column.
        return matrix
    names = ("fx", "fy", "cx", "cy")
    stated = [fields[name] for name in names if name in fields]
    if len(stated) < len(names):
        missing = [name for name in names if name not in fields]
        problem = f"camera {missing[0]!r} is missing"
        if not stated:
            problem = "'camera_matrix' is missing"
        raise ValueError(f"{problem}, there is {_keys(data) or 'nothing'}; {EXPECTED}")
    return _matrix_of(*numbers_of(stated, "fx, fy, cx, cy", 4))


def _matrix_of(fx: float, fy: float, cx: float, cy: float) -> Array:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _size(fields: Record, data: Record, size: Size | None) -> tuple[Any, Any]:
    """Width and height in pixels, or `size` if no field states either."""
    missing = [name for name in ("image_width", "image_height") if name not in fields]
    stated = fields.get("image_size")
    if not missing:
        stated = [fields["image_width"], fields["image_height"]]
    elif not isinstance(stated, list | tuple):  # a number called `size` is not one
        stated = size
        if len(missing) == 1:
            stated = None
    if stated is None:
        raise ValueError(
            f"{missing[0]!r} is missing (no image size), there is {_keys(data)}"
        )
    width, height = numbers_of([*stated], "image size (width, height)", 2)
    return width, height


def _refuse_unknown(data: Record, known: Strings = ()) -> None:
    """Refuse numbers that may change where a point lies in the image."""
    for key, value in data.items():
        if field_name(key) in (*_KNOWN, *known) or is_harmless(key):
            continue
        if isinstance(value, Mapping):
            value = value.get("data")
        cells = np.array(value, object).ravel().tolist()
        are_numbers = all(map(is_number, cells)) and any(map(float, cells))
        if are_numbers and not _is_matrix(key, value, len(cells)):
            raise ValueError(
                f"{key!r} is not known and may change the image; name distortion k1, k2, p1, p2,"
                f" k3, or distortion_coefficients in this order, beside fx; leave other numbers out"
            )


def _is_matrix(key: str, value: object, count: int) -> bool:
    """Whether numbers are a 3x3 or 4x4 matrix, or P of ROS, or another one in rows."""
    if LENS.search(plain_name(key)):
        return False
    if count in (9, 16):
        return True
    if count == 12 and _PROJECTION.match(plain_name(key)):
        return True
    if not isinstance(value, list) or len(value) < 3:
        return False
    return min(map(np.size, value)) > 2


def _binned(camera: Camera, fields: Record) -> Camera:
    """The camera of combined pixels: ROS states intrinsics and size of the sensor before that."""
    across = max(1, int(fields.get("binningx") or 1))
    down = max(1, int(fields.get("binningy") or 1))
    width = camera.width // across
    height = camera.height // down
    return camera.resized(width, height)


def states_size(data: Record) -> bool:
    """Whether fields state the size of the images."""
    return not {"image_width", "image_size"}.isdisjoint(map(field_name, data))


def off_centre(camera: Camera) -> float:
    """Distance of the principal point from the middle of the image, widths or heights."""
    right = (camera.cx + 0.5) / camera.width
    down = (camera.cy + 0.5) / camera.height
    return max(abs(right - 0.5), abs(down - 0.5))


def refuse_misfit(camera: Camera) -> None:
    """Refuse short focal lengths, and principal points outside of the image."""
    focal = min(camera.fx, camera.fy)
    if focal >= camera.width / 10 and off_centre(camera) <= 0.5:
        return
    numbers = f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g}"
    raise ValueError(
        f"{numbers} do not fit {camera.width}x{camera.height} images; give them in pixels and of"
        f" this image size"
    )


def _keys(data: Record) -> str:
    return few([str(key) for key in data], most=10)


def numbers_of(value: Any, name: str, count: int | None = None) -> list[float]:
    """Numbers of nested lists, or of an array of OpenCV or ROS; ValueError for others."""
    if isinstance(value, dict):
        value = value.get("data")
    try:
        if not isinstance(value, list) or bool in map(type, value):
            raise TypeError
        # YAML 1.1 reads 1e-05, as written by ROS, as a word.
        array = np.array(value, float)
        numbers = array.ravel().tolist()
    except (TypeError, ValueError):
        raise ValueError(f"'{name}' is a list of numbers, got {value!r}") from None
    if count is not None and len(numbers) != count:
        problem = f"{name} has {count} numbers, got {len(numbers)}"
        raise ValueError(f"{problem}; {EXPECTED}")
    return numbers
