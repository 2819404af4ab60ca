"""`LearnReport`: the outcome of learning a scene, printed and stored as JSON."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Self

from evercal.classes import frozen
from evercal.mapping.built_map import Adjusted
from evercal.typing import Floats, JsonObject, Record, Strings

if TYPE_CHECKING:
    from evercal.calibration.from_map.hand_eye import HandEye


@frozen
class SamePlace:
    """Another scene of the map that shows the place of a new one."""

    scene: str
    base: str
    """Name of its base; empty where it has none."""
    mm: float
    """Median distance of cameras between both bases."""
    deg: float
    same_base: bool
    """Whether both are in one base, to the uncertainty of both maps."""

    @property
    def distance(self) -> str:
        """For people."""
        return f"{self.mm:.1f} mm and {self.deg:.2f} deg"

    @property
    def agreement(self) -> str:
        """That both scenes are in one base."""
        return f"this place is mapped as {self.scene} too, in the same base ({self.distance} apart)"

    @property
    def warning(self) -> str:
        """What it means for the answers."""
        return (
            f"this place is mapped as {self.scene}, in a base {self.distance} from that of the"
            f" stated poses. Its images are ambiguous until `scene` names a scene. If the base or"
            f" most things were moved, remove the old scene: 'evercal map remove MAP {self.scene}'"
        )


@dataclass(frozen=True)
class LearnReport:
    """Outcome of learning a scene."""

    scene: str
    """Name of the scene."""
    seconds: float
    """Wall time."""
    memory_bytes: int
    """Size of the keyframes of all scenes."""
    frames_kept: int
    """Keyframes of this scene."""
    train_frames: int
    """Frames that were learned."""
    held_out_frames: int
    """Frames that the scatter of the stated poses was fitted to."""
    set_aside: Mapping[str, Floats] = field(default_factory=dict)
    """Distances of these frames, aligned in the map, from their stated poses, millimetres (unless
    the unit is unknown) and degrees: an independent check. Empty of one that is not aligned."""
    landmarks: int = 0
    """Landmarks of this scene."""
    adjusted: Adjusted | None = None
    """Changes by bundle adjustment; None for networks."""
    hand_eye: "HandEye | None" = None
    """The estimated camera on the gripper; None where the recording states camera poses."""
    fixed_share: float = 0.0
    """Share of the image that shows the same in all images and is not learned from."""
    same_place: tuple[SamePlace, ...] = ()
    """Scenes of the map that show the same place."""

    @property
    def warnings(self) -> Strings:
        """What the map knows to be wrong about its recording."""
        from evercal.learning.stated_warnings import stated_warnings

        warnings = []
        if self.adjusted:
            warnings += stated_warnings(self.adjusted, self.hand_eye is None)
        for other in self.same_place:
            if not other.same_base:
                warnings.append(other.warning)
        return tuple(warnings)

    def to_dict(self) -> JsonObject:
        """Return JSON values, as `evercal learn --json` prints them."""
        values = dict(vars(self))
        values["adjusted"] = self.adjusted and asdict(self.adjusted)
        values["hand_eye"] = self.hand_eye and self.hand_eye.to_dict()
        values["same_place"] = [asdict(other) for other in self.same_place]
        values["warnings"] = list(self.warnings)
        # Networks have others.
        values.setdefault("iterations", 0)
        values.setdefault("head_bytes", 0)
        return values

    @classmethod
    def from_stored(cls, values: Record) -> Self:
        """The inverse of `to_dict`."""
        from evercal.calibration.calibration import Calibration
        from evercal.calibration.from_map.hand_eye import HandEye

        own = {name: values[name] for name in cls.__dataclass_fields__}
        if own["adjusted"] is not None:
            own["adjusted"] = Adjusted(**own["adjusted"])
        if own["hand_eye"] is not None:
            calibration = Calibration.from_dict(own["hand_eye"])
            own["hand_eye"] = HandEye.from_dict(own["hand_eye"], calibration)
        own["same_place"] = tuple(SamePlace(**row) for row in own["same_place"])
        return cls(**own)
