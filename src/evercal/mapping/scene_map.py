"""`SceneMap`: the map of one scene as a robot keeps it, and the scenes of one map together."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.features.encoder import Encoder
from evercal.geometry import SE3, Camera, pose_distance
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.map_frame import MapFrame
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.typing import IntArray, Triple

if TYPE_CHECKING:
    from evercal.recordings.frame import Frame


@frozen_arrays
class SceneMap:
    """The map of one scene."""

    name: str
    """Unique in a map."""
    camera: Camera
    """Intrinsics that the recording states."""
    adjusted_camera: Camera
    """The same camera after bundle adjustment."""
    keyframes: Keyframes
    """With landmarks and descriptors."""
    frame: MapFrame
    """Relation of the landmarks' frame to the base frame."""
    train_frames: int
    """Frames that the map was built from."""
    intrinsics_sigma: Triple = (0.0, 0.0, 0.0)
    """Standard deviation of its intrinsics from image to image: focal length as a share, principal
    point as a share of the longer side, k1 and k2. A stabilised camera moves its image."""
    parent_frame: str = "base"
    """Frame of the answers: base, or gripper for the map of a thing that the gripper holds."""
    unit: float | None = None
    """Units of length of the recording per unit of the map; None where the recording is in metres.
    A map of unknown unit is normalised to the depths of a room."""
    frames: FrameNames = UNKNOWN
    """Names of the frames of the recording; `camera` is that of the camera that recorded it."""
    base: str = ""
    """Name of the robot's base, which scenes may share; empty where none was stated."""
    places: Mapping[str, SE3] = field(default_factory=dict)
    """place_from_base by place. Scenes of one place map the same surroundings, and those in one
    base have the same pose there, see `learning.mapped_already`."""

    @property
    def metric(self) -> bool:
        """Whether answers are in metres: of the recording, or by alignment with the base frame."""
        similarity = self.frame.similarity
        aligned = similarity is not None and similarity.metric
        return self.unit is None or aligned

    def in_metres(self, length: float) -> float | None:
        """Metres of a length of an answer; None where the unit of length is unknown."""
        return length if self.metric else None

    def at_room_scale(self, length: float) -> float:
        """A length of an answer, to be compared with a bound in metres.

        Where the unit is unknown, depths of the scene are taken to be those of a room.
        """
        metres = self.in_metres(length)
        return length / self.frame.scale if metres is None else metres

    @property
    def landmarks(self) -> int:
        """Number of landmarks."""
        return sum(map(len, self.keyframes.landmarks))

    @property
    def digest(self) -> str:
        """Identifies the map and its base frame: poses with the same digest share their errors."""
        digest = hashlib.sha256(b"".join(self.keyframes.images))
        digest.update(self.keyframes.base_from_camera.matrix().tobytes())
        similarity = self.frame.similarity
        if similarity:
            digest.update(similarity.base_from_map.matrix().tobytes())
            digest.update(np.float64(similarity.scale).tobytes())
        return digest.hexdigest()[:16]

    @property
    def own_place(self) -> dict[str, SE3]:
        """`places` of a scene that is the first one to map its place."""
        return {self.digest: SE3.identity()}


def base_from_other_base(scene: SceneMap, other: SceneMap) -> SE3 | None:
    """Pose of another scene's base in the base of a scene; None if they share no place."""
    shared = scene.places.keys() & other.places.keys()
    for place in sorted(shared):
        return scene.places[place].inverse() @ other.places[place]
    return None


def same_base(scene: SceneMap, other: SceneMap) -> bool:
    """Whether two scenes are in one base: by name, or by their poses where one has no name."""
    if scene.parent_frame != other.parent_frame:
        return False
    if scene.base and other.base:
        return scene.base == other.base
    between = base_from_other_base(scene, other)
    if between is None:
        return scene is other
    return bool(max(pose_distance(between, SE3.identity())) < 1e-9)


@dataclass
class MapContents:
    """The encoder and all scenes of a map, in memory."""

    encoder: Encoder
    """Frozen local encoder."""
    short_side: int
    """Shorter image side that the encoder works on, pixels."""
    scenes: list[SceneMap] = field(default_factory=list)
    """In order of learning."""

    @property
    def memory_bytes(self) -> int:
        """Size of all keyframes as they are stored."""
        return sum(scene.keyframes.bytes for scene in self.scenes)

    @property
    def names(self) -> list[str]:
        """Names of the scenes."""
        return [scene.name for scene in self.scenes]

    def with_replaced(self, index: int, scene: SceneMap) -> "MapContents":
        """The same map with another scene in one place.

        A localizer that still answers keeps the contents it was made with.
        """
        scenes = list(self.scenes)
        scenes[index] = scene
        return MapContents(self.encoder, self.short_side, scenes)

    def with_scene(self, scene: SceneMap) -> "MapContents":
        """The same map with one more scene."""
        return MapContents(self.encoder, self.short_side, [*self.scenes, scene])

    def within(self, names: Iterable[str]) -> "MapContents":
        """The same map with only some scenes."""
        wanted = {self.scene(name).name for name in names}
        scenes = [scene for scene in self.scenes if scene.name in wanted]
        return replace(self, scenes=scenes)

    def base_of(self, name: str) -> str:
        """The first scene in the base of a scene."""
        own = self.scene(name)
        alike = (other.name for other in self.scenes if same_base(other, own))
        return next(alike, name)

    def without(self, name: str | None) -> "MapContents":
        """The same map without one scene, or with all of them."""
        return self.within(other for other in self.names if other != name)

    def scene(self, name: str) -> SceneMap:
        """The map of a scene."""
        if name not in self.names:
            raise InputError(
                f"scene {name!r}: the map has only {', '.join(self.names)}"
            )
        return self.scenes[self.names.index(name)]

    def metric_scene(self, name: str) -> SceneMap:
        """The map of a scene whose answers are in metres."""
        scene = self.scene(name)
        if not scene.metric:
            raise InputError(
                f"scene {name}: the unit of length of its recording is unknown, so there are no"
                " millimetres; run 'evercal align' first, with `robot_poses` or with `points` and"
                " `picks`"
            )
        return scene

    def empty(self) -> "MapContents":
        """The same map without scenes."""
        return MapContents(self.encoder, self.short_side)


class LeftOut(NamedTuple):
    """Frames that are located without the keyframes recorded near them."""

    frames: "tuple[Frame, ...]"
    keyframes: IntArray
    """Indices of the other keyframes."""
