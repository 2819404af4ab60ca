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

    def completed_by(self, names: "FrameNames", source: object) -> "FrameNames":
        """These names of a source, and those given for its unknown frames; others are refused."""
        for role, name in vars(names).items():
            own = vars(self)[role] or name
            if name not in ("", own):
                raise InputError(
                    f"`{role}_frame` {name}: {source} states {own}; leave the option out"
                )
        return self.or_of(names)

    @classmethod
    def from_dict(cls, names: Any) -> Self:
        """The inverse of `asdict`; other values raise ValueError."""
        try:
            return cls(**{role: str(name or "") for role, name in dict(names).items()})
        except InputError as error:
            raise ValueError(str(error)) from None


UNKNOWN = FrameNames()
"""No frame is named."""
