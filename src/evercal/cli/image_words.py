"""Images and cameras as arguments."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from evercal.geometry import Camera


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
