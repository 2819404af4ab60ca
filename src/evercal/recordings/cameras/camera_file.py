"""Camera files: a matrix, JSON, YAML, NPZ, ROS camera_info, OpenCV's FileStorage, and others.

The content decides the kind, not the file ending; docs/formats.md lists the names of the fields. Of
ROS, both calibration files and printed messages are read, with the matrix K and D of the raw image.
A camera may stand inside other entries, such as `cam0` of a Kalibr chain. In all kinds, pixel
(0, 0) is the centre of the top-left pixel, and images are upright.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.geometry.camera import COEFFICIENTS
from evercal.recordings.cameras.radial_models import RADIAL_MODELS, nearest_fisheye
from evercal.recordings.poses.row_files import arrays_as_lists, is_number
from evercal.storage.text_files import documents, named_errors, naming, read_text
from evercal.typing import PathLike

# Kinds of models by name, and names of fields, in lower case without spaces, dashes, underscores.
_MODELS = {
    **dict.fromkeys(
        ("", "plumbbob", "rationalpolynomial", "brownconrady", "radtan", "radialtangential",
         "opencv", "fullopencv", "pinhole", "perspective", "rectified"), "brown"),
    **dict.fromkeys(("none", "null"), "none"),
    **dict.fromkeys(
        ("equidistant", "equi", "fisheye", "opencvfisheye", "kannalabrandt", "kannalabrandt4",
         "kannalabrandt8"), "fisheye"),
    **{name: name for name in RADIAL_MODELS}, "doublesphere": "ds", "atan": "fov",
}  # fmt: skip
_SUPPORTED = ("brown", "none", "zero", "fisheye")
_MODEL_KEYS = (
    "distortionmodel",
    "model",
    "cameramodel",
    "modeltype",
    "projectionmodel",
)
_LENGTHS = (0, 4, 5, 8)
_COEFFICIENTS = COEFFICIENTS["pinhole"]
_FISHEYE = COEFFICIENTS["fisheye"]
_ALIASES = {
    "camera_matrix": (
        "cameramatrix", "intrinsicmatrix", "cameraintrinsics", "intrinsics", "intrinsic",
        "projectionparameters", "k", "mtx",
    ),
    "distortion_coefficients": (
        "distortioncoefficients", "distortioncoeffs", "distortionparameters", "distortionparams",
        "distcoeffs", "distcoeff", "distortion", "dist", "coefficients", "coeffs", "d", "kc",
    ),
    "image_width": ("imagewidth", "width", "w"), "image_height": ("imageheight", "height", "h"),
    "image_size": ("imagesize", "imgsize", "resolution", "size"),
    "fx": ("fx",), "fy": ("fy",), "cx": ("cx", "ppx"), "cy": ("cy", "ppy"),
}  # fmt: skip
_LENS = ("distortion_coefficients", *_COEFFICIENTS)
_ROS = ("rectificationmatrix", "projectionmatrix", "header", "roi", "p", "r")
_KNOWN = {
    *_ALIASES,
    *_LENS,
    *_MODEL_KEYS,
    *_ROS[:4],
    "binningx",
    "binningy",
    "fisheyemodel",
}
_HARMLESS = re.compile(
    r"error|rms|repro|resid|std|dev|sigma|covar|uncert|fps|rate|freq|square|board|marker|pattern"
    r"|chess|tag|count|num|frames|images|views|points|flags|date|time|stamp|version|serial|index"
    r"|id$|baseline|depth|range|temp|apert|expos|gain|fov|angle|focal|aspect|mm$|rotation|trans"
    r"|^[rt]vec|quat|extrin|pose|position|orient|imu|noise|rgb|track|^bf$|^new|imagescale|overlaps"
    r"|^d[wh]$|^cameratype$|perframe"
)
"""Names of numbers that do not change where a point lies in the image."""
_EXPECTED = (
    "give a 3x3 matrix as text, JSON, YAML or NPZ with camera_matrix and dist_coeffs, a ROS"
    " camera_info or OpenCV's storage"
)


def read_camera(path: PathLike, size: tuple[int, int] | None = None) -> Camera:
    """Read the intrinsics of one camera.

    `size` is (width, height) of the images in pixels, for files without one.
    """
    path = Path(path)
    with named_errors(path, "camera file"):
        return camera_from_fields(fields_of(path, size), size)


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


def camera_from_fields(
    data: Mapping[str, Any], size: tuple[int, int] | None = None
) -> Camera:
    """Build a camera from the fields of a file, or of a ROS message.

    The camera may stand inside other fields. Of several, the only one of the images' size is taken.
    `size` is (width, height) in pixels of the images, if the fields may lack it. ValueError: the
    fields are no camera or several, or the images are distorted otherwise or cut out.
    """
    entries = [*_entries(_undotted(data), {}, "")] or [("", data)]
    cameras: dict[str, Camera] = {}
    for name, entry in entries:
        with naming(name) if name else nullcontext():
            cameras[name or "outside of these"] = _camera(entry, size)
    fitting = {c for c in cameras.values() if size in (None, (c.width, c.height))}
    choice = fitting or {*cameras.values()}
    if len(choice) > 1:
        each = (
            f"{n} ({c.width}x{c.height}, fx {c.fx:.1f})" for n, c in cameras.items()
        )
        raise ValueError(
            f"holds several cameras: {_listed(each)}; give a file of the right one"
        )
    return choice.pop()


def _undotted(data: Mapping[str, Any]) -> dict[str, Any]:
    """ORB-SLAM's `Camera1.fx` as an entry `Camera1`; `Camera.fps` holds for all cameras."""
    groups: dict[str, dict[str, Any]] = {"": {}, "Camera": {}}
    for key, value in data.items():
        group, _, name = str(key).rpartition(".")
        groups.setdefault(group, {})[
            "camera_model" if key == "Camera.type" else name
        ] = value
    return {**groups.pop(""), **groups.pop("Camera"), **groups}


def _entries(
    data: Mapping[str, Any], around: Mapping[str, Any], name: str
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Fields of all cameras in nested entries, by name, with numbers that stand around them."""
    data = dict(data)
    for key, value in [*data.items()]:  # such as intrinsics: {fx: ...}
        group = _canonical(key) in ("camera_matrix", "distortion_coefficients")
        if group and isinstance(value, Mapping) and "data" not in value:
            data |= {**data.pop(key), **data}
    own = _fields(data)
    hidden = {*own, *(() if own.keys().isdisjoint(_LENS) else _LENS)}
    around = {key: value for key, value in around.items() if key not in hidden}
    if "fx" in own or isinstance(own.get("camera_matrix"), list | Mapping):
        yield name, {**around, **data}
    focal = ("camera_matrix", "fx", "fy", "cx", "cy")
    around |= {key: value for key, value in own.items() if key not in focal}
    for key, value in data.items():
        for i, each in enumerate(value if isinstance(value, list) else [value]):
            if isinstance(each, Mapping):
                inner = f"{name}.{key}" + (f"[{i}]" if each is not value else "")
                yield from _entries(each, around, inner.lstrip("."))


def _camera(data: Mapping[str, Any], size: tuple[int, int] | None) -> Camera:
    fields = _fields(data)
    ros = not {_plain(key) for key in data}.isdisjoint(_ROS)
    roi = data.get("roi")
    if isinstance(roi, dict) and any(roi.get(key) for key in ("x_offset", "y_offset")):
        raise ValueError(
            f"the image is a cut-out (roi {roi}); give the whole image's camera_info"
        )
    models = {
        _model_kind(fields[key]): fields[key] for key in _MODEL_KEYS if key in fields
    }
    fisheye = "fisheye" in models or bool(fields.get("fisheyemodel"))
    if radial := next((kind for kind in models if kind in RADIAL_MODELS), None):
        return _of_radial_model(radial, fields, _size(fields, data, size))
    required = (ros or fisheye or "distortionmodel" in fields) and "none" not in models
    distortion = _distortion(
        fields, data, required, _FISHEYE if fisheye else _COEFFICIENTS
    )
    for kind in models.keys() - {"brown", "fisheye"}:
        if kind not in _SUPPORTED or any(distortion):
            raise ValueError(
                f"distortion_model {models[kind]!r} is not supported with the coefficients"
                f" {distortion}; rectify the images or calibrate with plumb_bob"
            )
    matrix = _matrix(fields, data)
    width, height = _size(fields, data, None if ros else size)
    _refuse_unknown(data)
    camera = Camera.from_matrix(matrix, width, height)
    model = "fisheye" if fisheye else "pinhole"
    camera = replace(camera, distortion=tuple(distortion), model=model)
    # ROS states intrinsics and size of the sensor, before it combines pixels.
    if size != (camera.width, camera.height):
        by = [max(1, int(fields.get(f"binning{axis}") or 1)) for axis in "xy"]
        camera = camera.resized(camera.width // by[0], camera.height // by[1])
    wide = camera.width
    high = camera.height
    inside = 0 <= camera.cx <= wide and 0 <= camera.cy <= high
    if min(camera.fx, camera.fy) < wide / 10 or not inside:
        raise ValueError(
            f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g} do not fit"
            f" {wide}x{high} images; give them in pixels and of this image size"
        )
    return camera


def _of_radial_model(
    kind: str, fields: Mapping[str, Any], size: tuple[Any, Any]
) -> Camera:
    """As Kalibr states it: parameters before the focal lengths, or the one of `fov` after them."""
    numbers = numbers_of(fields.get("camera_matrix"), "intrinsics")
    lens = "distortion_coefficients"
    terms = numbers_of(fields.get(lens, []), lens)
    if kind == "fov":
        numbers = [*terms, *numbers]
        terms = []
    names = (*RADIAL_MODELS[kind].parameters, "fx", "fy", "cx", "cy")
    if len(numbers) != len(names) or any(terms):
        raise ValueError(
            f"a camera of model {kind} has {_listed(names)} and no other distortion, got {numbers}"
            f" and {terms}; rectify the images or calibrate an equidistant model"
        )
    *own, fx, fy, cx, cy = numbers
    width = int(size[0])
    height = int(size[1])
    return nearest_fisheye(kind, own, (width, height), (fx, fy), (cx, cy))[0]


def _model_kind(model: object) -> str:
    """A value of `_MODELS`; `zero` for models that are read without distortion only, else empty."""
    plain = re.sub(r"[\s_-]", "", str(model).rpartition(".")[2].lower())
    # RealSense prints distortion.inverse_brown_conrady, mostly with zeros.
    return _MODELS.get(plain, "zero" if "conrady" in plain else "")


def _refuse_unknown(data: Mapping[str, Any]) -> None:
    for key, value in data.items():
        if _canonical(key) in _KNOWN or _HARMLESS.search(_plain(key)):
            continue
        value = value.get("data") if isinstance(value, Mapping) else value
        cells = np.ravel(np.array(value, dtype=object)).tolist()
        rows: list[Any] = value if isinstance(value, list) else []
        whole = (9, 12, 16) if _plain(key) == "p" else (9, 16)
        matrix = len(cells) in whole or (
            rows[2:] and all(np.size(row) > 2 for row in rows)
        )
        if all(map(is_number, cells)) and any(map(float, cells)) and not matrix:
            raise ValueError(
                f"{key!r} is not known and may change the image; name distortion k1, k2, p1, p2,"
                f" k3, or distortion_coefficients in this order, and leave other numbers out"
            )


def fields_of(path: Path, size: tuple[int, int] | None = None) -> Mapping[str, Any]:
    """Entries of a camera file, as written; ValueError for other files.

    A focal length alone has its principal point in the middle of images of `size`.
    """
    with path.open("rb") as file:
        zipped = file.read(2) == b"PK"
    if zipped:
        return arrays_as_lists(path)
    text = read_text(path, "camera file")
    words = re.sub(r"#.*|[,;\[\]]", " ", text).split()
    if all(map(is_number, words)):
        if len(words) == 1 and size is not None:
            cx = (size[0] - 1) / 2
            cy = (size[1] - 1) / 2
            words = [words[0], "0", str(cx), "0", words[0], str(cy), "0", "0", "1"]
        return {"camera_matrix": [float(word) for word in words]}
    try:
        if "<opencv_storage" in text:
            return _of_xml(text)
        # A printed message ends with '---', which opens a second, empty document.
        data = next(iter(documents(text, text.lstrip().startswith("{"))), None)
    except ValueError as error:
        raise ValueError(f"{error}; {_EXPECTED}") from None
    if not isinstance(data, dict):
        raise ValueError(f"no camera in it; {_EXPECTED}")
    return data


def _of_xml(text: str) -> dict[str, Any]:
    from xml.etree import ElementTree

    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities can expand without bound
        raise ValueError("it declares XML entities")
    try:
        return _xml_value(ElementTree.fromstring(text))
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML ({error})") from None


def _xml_value(element: Any) -> Any:
    data = element.find("data")
    words = (element.text or "").split()
    if data is not None:
        return {"data": (data.text or "").split()}
    if len(element):
        values = [(child.tag, _xml_value(child)) for child in element]
        return [value for _, value in values] if values[0][0] == "_" else dict(values)
    if not words or not all(map(is_number, words)):
        return " ".join(words)
    return float(words[0]) if len(words) == 1 else [float(word) for word in words]


def _plain(key: object) -> str:
    return str(key).lower().replace("_", "")


def _canonical(key: object) -> str:
    plain = _plain(key)
    return next((name for name, aliases in _ALIASES.items() if plain in aliases), plain)


def _fields(data: Mapping[str, Any]) -> dict[str, Any]:
    keys: dict[str, str] = {}
    for key in data:
        name = _canonical(key)
        if name in keys and name in (*_ALIASES, *_COEFFICIENTS):
            raise ValueError(f"{keys[name]} and {key} are the same; keep one of them")
        keys[name] = key
    return {name: data[key] for name, key in keys.items()}


def _matrix(fields: Mapping[str, Any], data: Mapping[str, Any]) -> np.ndarray:
    names = ("fx", "fy", "cx", "cy")
    if "camera_matrix" in fields:
        numbers = numbers_of(fields["camera_matrix"], "camera_matrix")
        # As Kalibr writes it; other orders differ in the first two.
        if len(numbers) == 4 and 0.8 * numbers[1] < numbers[0] < 1.25 * numbers[1]:
            return _matrix(dict(zip(names, numbers, strict=True)), data)
        if len(numbers) == 16 and numbers[3::4] == numbers[12:] == [0, 0, 0, 1]:
            numbers = np.reshape(numbers, (4, 4))[:3, :3].ravel().tolist()
        matrix = np.reshape(numbers_of(numbers, "camera_matrix", 9), (3, 3))
        # Open3D writes it column after column.
        return matrix.T if not matrix[:2, 2].any() and matrix[2, :2].any() else matrix
    missing = [name for name in names if name not in fields]
    if missing:
        what = f"camera {missing[0]!r}" if len(missing) < 4 else "'camera_matrix'"
        raise ValueError(
            f"{what} is missing, there is {_listed(data) or 'nothing'}; {_EXPECTED}"
        )
    fx, fy, cx, cy = numbers_of([fields[name] for name in names], "fx, fy, cx, cy", 4)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _distortion(
    fields: Mapping[str, Any],
    data: Mapping[str, Any],
    required: bool,
    names: Sequence[str],
) -> list[float]:
    name = "distortion_coefficients"
    stated = [key for key in names if key in fields]
    if other := [key for key in _COEFFICIENTS if fields.get(key) and key not in names]:
        raise ValueError(
            f"a fisheye has {_listed(names)}, got {_listed(other)}; leave others out"
        )
    numbers: list[float] = []
    if name in fields:
        nothing = str(fields[name]).lower() in ("none", "null")
        numbers = numbers if nothing else numbers_of(fields[name], name)
    elif stated:
        numbers = numbers_of([fields.get(key, 0.0) for key in names], stated[0])
        numbers = numbers if any(numbers[5:]) else numbers[:5]
    elif required:
        raise ValueError(
            f"{name!r} is missing, there is {_listed(data)}; write four zeros if images have no"
            f" lens distortion"
        )
    # Longer models add terms that are mostly zero and can then be dropped.
    while (
        len(numbers) not in (_LENGTHS if len(names) > 4 else (0, 4))
        and numbers[-1] == 0
    ):
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
        raise ValueError(
            f"{missing[0]!r} is missing (no image size), there is {_listed(data)}"
        )
    width, height = numbers_of(list(stated), "image size (width, height)", 2)
    return width, height


def _listed(keys: Iterable[object]) -> str:
    return ", ".join(map(str, keys))


def numbers_of(value: Any, name: str, count: int | None = None) -> list[float]:
    """Numbers of nested lists, or of an array of OpenCV or ROS; ValueError for others."""
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
