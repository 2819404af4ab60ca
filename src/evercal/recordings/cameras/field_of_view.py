"""Intrinsics of programs that state a field of view, or a focal length and a sensor.

MuJoCo (fovy, or focal length, sensor size and principal point), Isaac and USD (focal length and
apertures), Blender (lens, sensor, shifts), Gazebo (horizontal field of view), Metashape (f and the
distance of the principal point from the middle) and OpenICC. Angles below 3.2 are radians. The
image of a simulator is cut about its middle, so its principal point is at (width - 1) / 2.
"""

import math

from evercal.recordings.poses.row_files import by_alias
from evercal.typing import JsonObject, Pair, Record, Size

VIEW_NAMES = by_alias("""
fov_y: fovy vfov verticalfov fovvertical yfov camerafovy verticalfieldofview
fov_x: fovx hfov horizontalfov fovhorizontal xfov cameraanglex horizontalfieldofview
fov: fov fieldofview camerafov
focal: focallength f focal focalpixel lens
aperture: horizontalaperture sensorwidth sensorsize
aperture_y: verticalaperture sensorheight
aspect: aspectratio
centre: principalpixel
shift_x: shiftx
shift_y: shifty
b1: b1
""")
"""Names of this module by their aliases."""
_SETS = ("fov_y", "fov_x", "fov", "focalpixel", "focal aperture", "focal cx cy")
"""Fields that make a camera, any of these sets."""
_LARGEST_RADIANS = 3.2
_FROM_CORNER = 0.25
"""Share of the image beyond which a principal point is counted from the corner."""


def _view(fields: Record) -> JsonObject:
    """Fields by the names of this module."""
    return {VIEW_NAMES.get(name, name): value for name, value in fields.items()}


def has_view(fields: Record) -> bool:
    """Whether fields state intrinsics without a matrix or `fx`."""
    names = {*fields, *_view(fields)}
    return any(names.issuperset(words.split()) for words in _SETS)


def pixels_of_view(fields: Record, size: Size) -> JsonObject:
    """The fields with `fx`, `fy`, `cx` and `cy` in pixels of images of a size.

    ValueError: a field of view may be that of the width or of the height.
    """
    view = _view(fields)
    width, height = size
    if min(size) < 1:
        raise ValueError(f"the image size is width and height in pixels, got {size}")
    if "fov" in view and width != height and {"fov_x", "fov_y"}.isdisjoint(view):
        raise ValueError(
            f"'fov' {view['fov']} may be that of the width or of the height; name it fovx or fovy"
        )
    focal = _pair(view, "focal", 1.0)
    wide, high = _pair(view, "aperture")
    across = width
    if "focalpixel" in fields or ("cx" in fields and not wide):
        wide, high = size
        focal = focal[0], focal[1] * _pair(view, "aspect", 1.0)[0]
    elif "lens" in fields:
        # Blender's sensor is as wide as the longer side.
        fit = str(fields.get("sensorfit", "AUTO"))
        across = {"HORIZONTAL": width, "VERTICAL": height}.get(fit, max(size))
        if fit == "VERTICAL":
            wide = _number(view, "aperture_y")
        wide *= width / across
        high = 0.0
    elif not wide:
        wide = 2 * _tangent(_number(view, "fov_x"))
        high = 2 * _tangent(_number(view, "fov_y" if "fov_y" in view else "fov"))
    elif not isinstance(view["aperture"], list):
        high = _number(view, "aperture_y")
    wide = wide or high * width / height
    high = high or wide * height / width
    if not wide * high > 0:
        raise ValueError("the field of view, or the sensor, has no size")
    fx = focal[0] / wide * width
    fy = focal[1] / high * height
    right, down = _pair(view, "centre")
    cx = (width - 1) / 2 - right - _number(view, "shift_x") * across
    cy = (height - 1) / 2 - down + _number(view, "shift_y") * across
    pixels = {**fields, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    stated = [_number(view, name) for name in ("cx", "cy", "p2", "p1", "b1")]
    right, down, first, second, b1 = stated
    if max(abs(right / width), abs(down / height)) > _FROM_CORNER:
        pixels |= {"cx": right, "cy": down}
    elif "cx" in fields:
        # Metashape: from the middle; its tangential terms are in the other order.
        pixels |= {"cx": cx + right, "cy": cy + down, "fx": fx + b1}
        pixels |= {"p1": first, "p2": second}
    return pixels


def _number(view: Record, name: str) -> float:
    return _pair(view, name)[0]


def _pair(view: Record, name: str, default: float = 0.0) -> Pair:
    """Two numbers, or one for both axes."""
    value = view.get(name, default)
    try:
        x, y = value if isinstance(value, list) else (value, value)
        return float(x), float(y)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is a number, got {value!r}") from None


def _tangent(angle: float) -> float:
    if angle >= _LARGEST_RADIANS:
        angle = math.radians(angle)
    return math.tan(angle / 2)
