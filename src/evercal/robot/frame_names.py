"""`FrameNames`: what the robot's software calls the frames of a calibration."""

from typing import Any, Self

from evercal.classes import frozen
from evercal.errors import InputError


@frozen
class FrameNames:
    """Names of frames, such as those of a tf tree or the links of a URDF; empty where unknown."""

    base: str = ""
    """Frame that gripper poses are stated in."""
    gripper: str = ""
    """Frame whose poses are stated."""
    camera: str = ""
    """The camera's optical frame."""

    def __post_init__(self) -> None:
        """Refuse two frames of one name."""
        names = [*filter(None, vars(self).values())]
        for name in names:
            if names.count(name) > 1:
                raise InputError(
                    f"two frames are both called {name!r}; rename one of them (`camera_frame`, or"
                    " `child` of an export)"
                )

    def or_of(self, other: "FrameNames") -> "FrameNames":
        """These names; those of `other` where they are unknown."""
        return FrameNames(
            self.base or other.base,
            self.gripper or other.gripper,
            self.camera or other.camera,
        )

    @classmethod
    def from_dict(cls, names: Any) -> Self:
        """The inverse of `asdict`; other values raise ValueError."""
        if not all(isinstance(name, str) for name in names.values()):
            raise ValueError(f"names of frames are texts, got {names}")
        try:
            return cls(**names)
        except InputError as error:
            raise ValueError(str(error)) from None


UNKNOWN = FrameNames()
"""No frame is named."""
