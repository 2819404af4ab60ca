"""The intrinsics of an image in the scenes of a map, before it is located."""

from collections.abc import Sequence

import numpy as np

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.localization.intrinsics import OWN, STATED, UNKNOWN, IntrinsicsPrior
from evercal.localization.learned import LearnedScene


def own_or_stated(stated: Camera, recorded: Sequence[Camera]) -> Camera | None:
    """None for intrinsics that a scene's recording states, else the stated ones."""
    return None if stated in recorded else stated


def cameras_in_scenes(
    camera: Camera | None, image: np.ndarray, scenes: Sequence[LearnedScene]
) -> list[Camera]:
    """Intrinsics of an image in each scene; a guess where none are given and no aspect ratio fits.

    Raises:
        InputError: A camera with another aspect ratio than the image's.
    """
    height, width = image.shape[:2]
    if camera is not None:
        if not camera.fits(width, height):
            raise InputError(
                f"camera {camera.width}x{camera.height} does not fit the image {width}x{height}:"
                " give intrinsics of the same aspect ratio"
            )
        return [camera.resized(width, height)] * len(scenes)
    return [_own(scene.adjusted_camera, width, height) for scene in scenes]


def _own(recorded: Camera, width: int, height: int) -> Camera:
    """The camera of a recording for an image of another size."""
    if recorded.fits(width, height):
        return recorded.resized(width, height)
    scale = max(width, height) / max(recorded.width, recorded.height)
    middle = (width - 1) / 2, (height - 1) / 2
    return Camera(width, height, scale * recorded.fx, scale * recorded.fy, *middle)


def prior_of(camera: Camera | None, image: np.ndarray, recorded: Camera) -> IntrinsicsPrior:
    """Prior of the intrinsics of an image: stated, the recording's, or unknown."""
    if camera is not None:
        return STATED
    height, width = image.shape[:2]
    if (width, height) == (recorded.width, recorded.height):
        return OWN
    larger, smaller = max(width, recorded.width), min(width, recorded.width)
    whole = larger % smaller == 0 and recorded.width * height == recorded.height * width
    # An image of half the size is probably resized; other sizes may be cropped.
    return STATED if whole else UNKNOWN
