"""Camera files: a matrix, JSON, YAML, NPZ, ROS camera_info, OpenCV's FileStorage, and others.

The content decides the kind, not the file ending. Of ROS, both calibration files and printed
messages are read. A camera may stand inside other entries, such as `cam0` of a Kalibr chain.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.cameras.camera_fields import (
    DISTORTION,
    EXPECTED,
    camera_of,
    field_name,
    named_fields,
)
from evercal.recordings.poses.array_files import arrays_as_lists
from evercal.recordings.poses.row_files import is_number
from evercal.storage.text_files import documents, few, named_errors, naming, read_text
from evercal.typing import JsonObject, PathLike, Record, Size

_OF_ONE_CAMERA = ("camera_matrix", "fx", "fy", "cx", "cy")
"""Record that do not hold for the cameras inside an entry."""


def read_camera(path: PathLike, size: Size | None = None) -> Camera:
    """Read the intrinsics of one camera.

    `size` is (width, height) of the images in pixels, for files without one.
    """
    path = Path(path)
    with named_errors(path, "camera file"):
        return camera_from_fields(fields_of(path, size), size)


def read_camera_of_size(path: Path, size: Size, images: str) -> Camera:
    """Read the intrinsics of images of one size; another size is refused."""
    camera = read_camera(path, size)
    check_size(str(path), camera, size, images)
    return camera


def check_size(source: str, camera: Camera, size: Size, images: str) -> None:
    """Raise `InputError` if a camera from `source` has another size than its images."""
    width, height = size
    if camera.width != width or camera.height != height:
        raise InputError(
            f"{source}: is for images of {camera.width}x{camera.height}, {images} is"
            f" {width}x{height}; give the intrinsics of this image size with `camera`"
        )


def camera_from_fields(data: Record, size: Size | None = None) -> Camera:
    """Build a camera from the fields of a file, or of a ROS message.

    The camera may stand inside other fields. Of several, the only one of the images' size is taken.
    `size` is (width, height) in pixels of the images, if the fields may lack it. ValueError: the
    fields are no camera or several, or the images are distorted otherwise or cut out.
    """
    others = ("lenses", "for_stated_lens")  # of a calibration, beside its camera
    data = {key: value for key, value in data.items() if key not in others}
    entries = [*_entries(_undotted(data), {}, "")]
    if not entries:
        return camera_of(data, size)
    cameras: dict[str, Camera] = {}
    for name, entry in entries:
        if name:
            with naming(name):
                cameras[name] = camera_of(entry, size)
        else:
            cameras["outside of these"] = camera_of(entry, size)
    fitting = {camera for camera in cameras.values() if camera.size == size}
    choice = fitting or {*cameras.values()}
    if len(choice) == 1:
        return choice.pop()
    descriptions = []
    for name, camera in cameras.items():
        pixels = f"{camera.width}x{camera.height}"
        descriptions.append(f"{name} ({pixels}, fx {camera.fx:.1f})")
    raise ValueError(
        f"holds several cameras: {few(descriptions)}; give a file of the right one"
    )


def _undotted(data: Record) -> JsonObject:
    """ORB-SLAM's `Camera1.fx` as an entry `Camera1`; `Camera.fps` holds for all cameras."""
    groups: dict[str, JsonObject] = {"": {}, "Camera": {}}
    for key, value in data.items():
        group, _, name = str(key).rpartition(".")
        if key == "Camera.type":
            name = "camera_model"
        groups.setdefault(group, {})[name] = value
    plain = groups.pop("")
    for_all = groups.pop("Camera")
    return {**plain, **for_all, **groups}


def _entries(data: Record, around: Record, name: str) -> Iterator[tuple[str, Record]]:
    """Record of all cameras in nested entries, by name, with numbers that stand around them."""
    data = _ungrouped(data)
    fields = named_fields(data)
    hidden = set(fields)
    if not hidden.isdisjoint(DISTORTION):
        hidden.update(DISTORTION)
    inherited = {key: value for key, value in around.items() if key not in hidden}
    matrix = fields.get("camera_matrix")
    if "fx" in fields or isinstance(matrix, list | dict):
        yield name, {**inherited, **data}
    for key, value in fields.items():
        if key not in _OF_ONE_CAMERA:
            inherited[key] = value
    for key, value in data.items():
        inner = f"{name}.{key}".lstrip(".")
        parts = {inner: value}
        if isinstance(value, list):
            parts = {f"{inner}[{i}]": entry for i, entry in enumerate(value)}
        for part, entry in parts.items():
            if isinstance(entry, dict):
                yield from _entries(entry, inherited, part)


def _ungrouped(data: Record) -> JsonObject:
    """Record such as `intrinsics: {fx: ...}` without that group."""
    fields = dict(data)
    for key, value in data.items():
        group = field_name(key) in ("camera_matrix", "distortion_coefficients")
        if group and isinstance(value, dict) and "data" not in value:
            for inner, number in fields.pop(key).items():
                fields.setdefault(inner, number)
    return fields


def fields_of(path: Path, size: Size | None = None) -> Record:
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
        numbers = [*map(float, words)]
        if len(numbers) == 1 and size:
            numbers = centred_camera(numbers[0], size).matrix().ravel().tolist()
        return {"camera_matrix": numbers}
    try:
        if "<opencv_storage" in text:
            return _of_xml(text)
        is_json = text.lstrip().startswith("{")
        # A printed message ends with '---', which opens a second, empty document.
        data, *_ = [*documents(text, is_json), None]
    except ValueError as error:
        raise ValueError(f"{error}; {EXPECTED}") from None
    if not isinstance(data, dict):
        raise ValueError(f"no camera in it; {EXPECTED}")
    return data


def centred_camera(focal_px: float, size: Size) -> Camera:
    """The camera of a focal length, with the principal point in the middle of the image."""
    width, height = size
    centre = ((width - 1) / 2, (height - 1) / 2)
    return Camera(width, height, focal_px, focal_px, *centre)


def _of_xml(text: str) -> JsonObject:
    from xml.etree import ElementTree

    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities can expand without bound
        raise ValueError("it declares XML entities")
    try:
        return _xml_value(ElementTree.fromstring(text))
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML ({error})") from None


def _xml_value(element: Any) -> Any:
    """An array, a list, an object, or else a word or one or more numbers."""
    data = element.find("data")
    if data is not None:
        return {"data": (data.text or "").split()}
    if len(element):
        values = [*map(_xml_value, element)]
        tags = [child.tag for child in element]
        if tags[0] == "_":
            return values
        return dict(zip(tags, values, strict=True))
    words = (element.text or "").split()
    if not words or not all(map(is_number, words)):
        return " ".join(words)
    numbers = [*map(float, words)]
    if len(numbers) == 1:
        return numbers[0]
    return numbers
