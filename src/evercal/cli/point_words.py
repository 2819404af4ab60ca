"""A point seen from the camera as an argument, and its error in the parent frame."""

import math
from typing import TYPE_CHECKING

from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.geometry import UncertainPose

Point = tuple[float, float, float]


def point_of(text: str | None) -> Point | None:
    """The point (x, y, z) of --at in the camera frame, metres; None if the option was omitted.

    Raises:
        InputError: The text is not three numbers.
    """
    if text is None:
        return None
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise InputError(f"--at {text}: give x,y,z in metres such as 0,0.05,0.4")
    return x, y, z


def point_dict(point: Point, parent_from_camera: "UncertainPose") -> dict[str, object]:
    """The point in both frames and its standard deviation per axis."""
    return {
        "point_m": list(point),
        "in_parent_m": parent_from_camera.pose.apply(point).tolist(),
        "sigma_mm": parent_from_camera.point_sigma_mm(point),
    }


def point_text(point: Point, parent_from_camera: "UncertainPose") -> str:
    """The standard deviation of the point in words."""
    x, y, z = point
    sigma = parent_from_camera.point_sigma_mm(point)
    return f"{sigma:.2f} mm at ({x:g}, {y:g}, {z:g}) m in the camera frame"
