"""Pictures that may be unreadable: files, or images in memory."""

from typing import Protocol

import numpy as np

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.localization.estimate import PoseEstimate
from evercal.recordings.images import Picture, pixels_of
from evercal.typing import Strings


class SceneLocalizer(Protocol):
    """What locates images in scenes: a `Localizer`, or a stand-in with the same methods."""

    @property
    def scenes(self) -> Strings:
        """Names of the scenes, in order of learning."""
        ...

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        """Estimate the camera pose of one image."""
        ...


def localize_picture(
    localizer: SceneLocalizer, image: Picture, camera: Camera | None = None
) -> PoseEstimate:
    """Locate a picture; one that cannot be read is `failed`, with the reason."""
    try:
        pixels = pixels_of(image)
    except InputError as error:
        return PoseEstimate.failed(str(error))
    return localizer.localize(pixels, camera)
