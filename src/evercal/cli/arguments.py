"""What arguments stand for: images, intrinsics, a point in the camera frame, a store."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from evercal.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from evercal.geometry import Camera, UncertainPose
    from evercal.localization.learned import LearnedLocalizer
    from evercal.localization.localizer import Localizer

Point = tuple[float, float, float]
MAP = "evercal"
"""The strategy of a map."""


def read_images(files: Sequence[Path]) -> "list[tuple[str, np.ndarray]]":
    """Read image files: (path, pixels)."""
    from evercal.recordings import read_image

    return [(str(path), read_image(path)) for path in files]


def camera_for(file: Path | None, images: Sequence[Path]) -> "Camera | None":
    """The camera in the file of --camera, for the size of the first image."""
    if file is None:
        return None
    from evercal.recordings import image_size

    return stated_camera(file, image_size(images[0]))


def stated_camera(file: Path | None, size: tuple[int, int]) -> "Camera | None":
    """The camera in the file of --camera, for images of (width, height)."""
    if file is None:
        return None
    from evercal.recordings.poses.camera_file import read_camera

    return read_camera(file, size)


def point_of(text: str | None) -> Point | None:
    """The point (x, y, z) of --at in the camera frame, metres; None if the option was omitted."""
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


def strategy_of(store: Path) -> str | None:
    """The strategy that a store was made with; None if there is no store yet."""
    from evercal.storage import read_manifest
    from evercal.storage.stages import is_store

    return str(read_manifest(store)["strategy"]) if is_store(store) else None


def open_localizer(store: Path, device: str) -> "LearnedLocalizer":
    """The localizer of a store of either kind."""
    if strategy_of(store) in (MAP, None):
        from evercal.localization.localizer import Localizer

        return Localizer.open(store, device=device)
    from evercal.continual.localizer import open_networks

    return open_networks(store, device)


def open_map(store: Path, device: str) -> "Localizer":
    """The localizer of a map."""
    strategy = strategy_of(store)
    if strategy not in (MAP, None):
        raise InputError(
            f"{store}: holds networks of strategy {strategy}, and this needs a map; learn the scene"
            " with the default strategy"
        )
    from evercal.localization.localizer import Localizer

    return Localizer.open(store, device=device)
