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
from evercal.recordings.cameras.radial_models import RADIAL_MODELS, nearest_fisheye
from evercal.recordings.poses.row_files import by_alias, is_number
from evercal.storage.text_files import few
from evercal.typing import Array, Floats, JsonObject, Record, Size

_NAMES = by_alias("""
camera_matrix: cameramatrix intrinsicmatrix mtx k
camera_matrix: cameraintrinsics intrinsics intrinsic
camera_matrix: projectionparameters
distortion_coefficients: distortioncoefficients distortioncoeffs
distortion_coefficients: distortionparameters distortionparams
distortion_coefficients: distcoeffs distcoeff distortion dist
distortion_coefficients: coefficients coeffs d kc
image_width: imagewidth width w
image_height: imageheight height h
image_size: imagesize imgsize resolution size
fx: fx
fy: fy
cx: cx ppx
cy: cy ppy
""")
"""Names of fields by their aliases."""
_MODELS = {"": "brown"} | by_alias("""
brown: plumbbob rationalpolynomial
brown: brownconrady radtan radialtangential
brown: opencv fullopencv
brown: pinhole perspective rectified
none: none null
fisheye: fisheye opencvfisheye
fisheye: equidistant equi
fisheye: kannalabrandt kannalabrandt4 kannalabrandt8
fov: fov atan
omni: omni
eucm: eucm
ds: ds doublesphere
""")
"""Kinds of distortion by names of models, without spaces, dashes and underscores."""
_MODEL_NAMES = (
    "distortionmodel",
    "model",
    "cameramodel",
    "modeltype",
    "projectionmodel",
)
"""Names of fields that hold the name of a model."""
_PINHOLE = COEFFICIENTS["pinhole"]
DISTORTION = ("distortion_coefficients", *_PINHOLE)
"""Names of fields that hold distortion."""
_UNIQUE = {*_NAMES.values(), *_PINHOLE}
"""Record that may be stated once."""
_CAMERA_INFO = {
    "rectificationmatrix",
    "projectionmatrix",
    "header",
    "roi",
}
"""Names of fields of ROS."""
_RECTIFIED = {"p", "r"}
"""Names of the matrices of ROS for rectified images."""
_KNOWN = {
    *_NAMES.values(),
    *DISTORTION,
    *_MODEL_NAMES,
    *_CAMERA_INFO,
    "binningx",
    "binningy",
    "fisheyemodel",
}
"""Names of fields that are used, or that may be left out."""
_HARMLESS = re.compile(
    r"error|rms|repro|resid|std|dev|sigma|covar|uncert|fps|rate|freq|square|board|marker|pattern"
    r"|chess|tag|count|num|frames|images|views|points|flags|date|time|stamp|version|serial|index"
    r"|id$|baseline|depth|range|temp|apert|expos|gain|fov|angle|focal|aspect|mm$|rotation|trans"
    r"|^[rt]vec|quat|extrin|pose|position|orient|imu|noise|rgb|track|^bf$|^new|imagescale|overlaps"
    r"|^d[wh]$|^cameratype$|perframe"
)
"""Names of numbers that do not change where a point lies in the image."""
EXPECTED = (
    "give a 3x3 matrix as text, JSON, YAML or NPZ with camera_matrix and dist_coeffs, a ROS"
    " camera_info or OpenCV's storage"
)
"""What a camera file may hold, for messages."""


def field_name(key: object) -> str:
    """The name that a key is an alias of, or else the key in lower case."""
    plain = _plain(key)
    return _NAMES.get(plain, plain)


def named_fields(data: Record) -> JsonObject:
    """Values by `field_name`; ValueError if two keys are the same field."""
    keys = {}
    fields = {}
    for key in data:
        name = field_name(key)
        if name in keys and name in _UNIQUE:
            raise ValueError(f"{keys[name]} and {key} are the same; keep one of them")
        keys[name] = key
        fields[name] = data[key]
    return fields


def camera_of(data: Record, size: Size | None) -> Camera:
    """One camera from its fields.

    `size` is (width, height) in pixels of images, for fields without a size. ValueError: they are
    no camera, or the images are cut out or distorted otherwise.
    """
    fields = named_fields(data)
    roi = data.get("roi")
    if isinstance(roi, dict) and (roi.get("x_offset") or roi.get("y_offset")):
        raise ValueError(
            f"the image is a cut-out (roi {roi}); give the whole image's camera_info"
        )
    models: JsonObject = {}
    for name in _MODEL_NAMES:
        if name in fields:
            models[_model_kind(fields[name])] = fields[name]
    for kind in models:
        if kind in RADIAL_MODELS:
            return _of_radial_model(kind, fields, _size(fields, data, size))
    plain = {*map(_plain, data)}
    is_ros = bool(plain & (_CAMERA_INFO | _RECTIFIED))
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
    _refuse_unknown(data)
    camera = Camera.from_matrix(matrix, width, height)
    camera = replace(camera, distortion=distortion, model=model)
    if size != camera.size:
        camera = _binned(camera, fields)
    _refuse_misfit(camera)
    return camera


def _model_kind(model: object) -> str:
    """A value of `_MODELS`; `zero` for models that are read without distortion only, else empty."""
    _, _, name = str(model).rpartition(".")
    plain = re.sub(r"[\s_-]", "", name.lower())
    kind = _MODELS.get(plain, "")
    if not kind and "conrady" in plain:
        # RealSense prints distortion.inverse_brown_conrady, mostly with zeros.
        return "zero"
    return kind


def _of_radial_model(kind: str, fields: Record, size: tuple[Any, Any]) -> Camera:
    """As Kalibr states it: parameters before the focal lengths, or the one of `fov` after them."""
    numbers = numbers_of(fields.get("camera_matrix"), "intrinsics")
    name = "distortion_coefficients"
    distortion = numbers_of(fields.get(name, []), name)
    if kind == "fov":
        numbers = [*distortion, *numbers]
        distortion = []
    names = (*RADIAL_MODELS[kind], "fx", "fy", "cx", "cy")
    if len(numbers) != len(names) or any(distortion):
        expected = f"a camera of model {kind} has {', '.join(names)}"
        raise ValueError(
            f"{expected} and no other distortion, got {numbers} and {distortion}; rectify the"
            f" images or calibrate an equidistant model"
        )
    *parameters, fx, fy, cx, cy = numbers
    width, height = map(int, size)
    return nearest_fisheye(kind, parameters, (width, height), (fx, fy), (cx, cy))


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
    stated = [name for name in names if name in fields]
    if key in fields:
        if str(fields[key]).lower() in ("none", "null"):
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
    names = ("fx", "fy", "cx", "cy")
    if "camera_matrix" in fields:
        numbers = numbers_of(fields["camera_matrix"], "camera_matrix")
        if len(numbers) == 4:
            fx, fy, cx, cy = numbers
            # As Kalibr writes it; other orders differ in the first two.
            if 0.8 * fy < fx < 1.25 * fy:
                return _matrix_of(fx, fy, cx, cy)
        if len(numbers) == 16:
            last = [0, 0, 0, 1]
            if numbers[12:] == last and numbers[3::4] == last:
                numbers = np.reshape(numbers, (4, 4))[:3, :3].ravel().tolist()
        numbers = numbers_of(numbers, "camera_matrix", 9)
        matrix = np.reshape(numbers, (3, 3))
        if matrix[2, :2].any() and not matrix[:2, 2].any():
            return matrix.T  # Open3D writes it column after column.
        return matrix
    missing = [name for name in names if name not in fields]
    if missing:
        problem = "'camera_matrix' is missing"
        if len(missing) < len(names):
            problem = f"camera {missing[0]!r} is missing"
        stated = _keys(data) or "nothing"
        raise ValueError(f"{problem}, there is {stated}; {EXPECTED}")
    values = [fields[name] for name in names]
    return _matrix_of(*numbers_of(values, "fx, fy, cx, cy", 4))


def _matrix_of(fx: float, fy: float, cx: float, cy: float) -> Array:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _size(fields: Record, data: Record, size: Size | None) -> tuple[Any, Any]:
    """Width and height in pixels, or `size` if no field states either."""
    missing = [name for name in ("image_width", "image_height") if name not in fields]
    stated = fields.get("image_size")
    if not missing:
        stated = [fields["image_width"], fields["image_height"]]
    elif isinstance(stated, Mapping):
        return _size(named_fields(stated), stated, None)
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


def _refuse_unknown(data: Record) -> None:
    """Refuse numbers that may change where a point lies in the image."""
    for key, value in data.items():
        if field_name(key) in _KNOWN or _HARMLESS.search(_plain(key)):
            continue
        if isinstance(value, Mapping):
            value = value.get("data")
        cells = np.array(value, object).ravel().tolist()
        are_numbers = all(map(is_number, cells)) and any(map(float, cells))
        if are_numbers and not _is_matrix(key, value, len(cells)):
            raise ValueError(
                f"{key!r} is not known and may change the image; name distortion k1, k2, p1, p2,"
                f" k3, or distortion_coefficients in this order, and leave other numbers out"
            )


def _is_matrix(key: object, value: object, count: int) -> bool:
    """Whether numbers are a 3x3 or 4x4 matrix, or P of ROS, or another one in rows."""
    if count in (9, 16):
        return True
    if count == 12 and _plain(key) == "p":
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


def _refuse_misfit(camera: Camera) -> None:
    """Refuse short focal lengths, and principal points outside of the image."""
    focal = min(camera.fx, camera.fy)
    plausible = focal >= camera.width / 10
    inside_x = 0 <= camera.cx <= camera.width
    inside_y = 0 <= camera.cy <= camera.height
    if plausible and inside_x and inside_y:
        return
    numbers = f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g}"
    raise ValueError(
        f"{numbers} do not fit {camera.width}x{camera.height} images; give them in pixels and of"
        f" this image size"
    )


def _keys(data: Record) -> str:
    return few([str(key) for key in data], most=10)


def _plain(key: object) -> str:
    return str(key).lower().replace("_", "")


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
