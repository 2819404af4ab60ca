"""What localizers of maps and of networks have in common."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.localization.estimate import PoseEstimate
from evercal.mapping.map_frame import MapFrame
from evercal.recordings.images import Picture, pixels_of


class LearnedScene(Protocol):
    """A scene of either kind of store."""

    @property
    def name(self) -> str:
        """Name of the scene."""
        ...

    @property
    def camera(self) -> Camera:
        """Intrinsics that its recording states."""
        ...

    @property
    def adjusted_camera(self) -> Camera:
        """The same camera after learning."""
        ...

    @property
    def frame(self) -> MapFrame:
        """Relation of its scene points to the base frame."""
        ...


class LearnedContents(Protocol):
    """The scenes of either kind of store."""

    @property
    def short_side(self) -> int:
        """Shorter image side that the encoder works on, pixels."""
        ...

    @property
    def scenes(self) -> Sequence[LearnedScene]:
        """In order of learning."""
        ...


class SceneLocalizer(Protocol):
    """What both kinds of store answer with: a map's `Localizer`, and that of networks."""

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order of learning."""
        ...

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        """Estimate the camera pose of one image."""
        ...


class LearnedLocalizer(SceneLocalizer, Protocol):
    """A localizer whose scenes can be inspected."""

    @property
    def contents(self) -> LearnedContents:
        """The scenes."""
        ...


def localize_picture(
    localizer: SceneLocalizer, image: Picture, camera: Camera | None = None
) -> PoseEstimate:
    """Locate a picture; one that cannot be read is `failed`, with the reason."""
    try:
        pixels = pixels_of(image)
    except InputError as error:
        return PoseEstimate("failed", str(error), None, None, None, 0, 0.0, 0.0)
    return localizer.localize(pixels, camera)
