"""What reports need of a localizer and its scenes, of maps and of networks."""

from collections.abc import Sequence
from typing import Protocol

from evercal.geometry import Camera
from evercal.localization.pictures import SceneLocalizer
from evercal.mapping.map_frame import MapFrame


class LearnedScene(Protocol):
    """A scene of a map or of networks."""

    @property
    def name(self) -> str:
        """Name of the scene."""
        ...

    @property
    def adjusted_camera(self) -> Camera:
        """The camera of its recording after learning."""
        ...

    @property
    def frame(self) -> MapFrame:
        """Relation of its scene points to the base frame."""
        ...


class LearnedContents(Protocol):
    """The scenes of a map or of networks."""

    @property
    def short_side(self) -> int:
        """Shorter image side that the encoder works on, pixels."""
        ...

    @property
    def scenes(self) -> Sequence[LearnedScene]:
        """In order of learning."""
        ...


class LearnedLocalizer(SceneLocalizer, Protocol):
    """A localizer whose scenes can be inspected."""

    @property
    def contents(self) -> LearnedContents:
        """The scenes."""
        ...
