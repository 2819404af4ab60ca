"""Intrinsics of programs that state a field of view, or a focal length and a sensor.

MuJoCo (fovy, or focal length, sensor size and principal point), Isaac and USD (focal length and
apertures), Blender (lens, sensor, shifts), Gazebo (horizontal field of view), Metashape (f and the
distance of the principal point from the middle) and OpenICC. Angles below 3.2 are radians. The
image of a simulator is cut about its middle, so its principal point is at (width - 1) / 2.
"""

import math
from typing import Any

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
    if "fov" in view and width != height and {"fov_x", "fov_y"}.isdisjoint(view):
        raise ValueError(
            f"'fov' {view['fov']} may be that of the width or of the height; name it fovx or fovy"
        )
    focal = _pair(view.get("focal", 1.0))
    wide, high = 0.0, 0.0
    across = width
    if "focalpixel" in fields or ("cx" in fields and "aperture" not in view):
        wide, high = width, height / float(view.get("aspect", 1))
    elif "lens" in fields:
        # Blender's sensor is as wide as the longer side.
        fit = str(fields.get("sensorfit", "AUTO"))
        across = {"HORIZONTAL": width, "VERTICAL": height}.get(fit, max(size))
        wide = float(view["aperture_y" if fit == "VERTICAL" else "aperture"])
        wide *= width / across
    elif "aperture" in view and "focal" in view:
        wide, high = _pair(view["aperture"])
        if not isinstance(view["aperture"], list):
            high = float(view.get("aperture_y", 0))
    else:
        wide = 2 * _tangent(view.get("fov_x", 0))
        high = 2 * _tangent(view.get("fov_y", view.get("fov", 0)))
    wide = wide or high * width / height
    high = high or wide * height / width
    fx = focal[0] / wide * width
    fy = focal[1] / high * height
    right, down = _pair(view.get("centre", 0))
    cx = (width - 1) / 2 - right - float(view.get("shift_x", 0)) * across
    cy = (height - 1) / 2 - down + float(view.get("shift_y", 0)) * across
    pixels = {**fields, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    stated = [float(fields.get(name, 0)) for name in ("cx", "cy", "p2", "p1", "b1")]
    if max(abs(stated[0] / width), abs(stated[1] / height)) > 0.25:
        pixels |= {"cx": stated[0], "cy": stated[1]}
    elif "cx" in fields:
        # Metashape: from the middle; its tangential terms are in the other order.
        pixels |= {"cx": cx + stated[0], "cy": cy + stated[1]}
        pixels |= {"p1": stated[2], "p2": stated[3], "fx": fx + stated[4]}
    return pixels


def _pair(value: Any) -> Pair:
    """Two numbers, or one for both axes."""
    x, y = value if isinstance(value, list) else (value, value)
    return float(x), float(y)


def _tangent(angle: Any) -> float:
    angle = float(angle)
    if angle >= _LARGEST_RADIANS:
        angle = math.radians(angle)
    return math.tan(angle / 2)
