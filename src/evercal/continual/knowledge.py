"""What a robot knows: networks, atlas, memory and a record of every scene."""

import copy
from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

from evercal.continual.atlas import Atlas, Cell
from evercal.continual.memory import Memory
from evercal.continual.notes import Notes
from evercal.geometry.camera import Camera
from evercal.models.descriptor import Descriptor
from evercal.models.encoder import Encoder
from evercal.models.head import Head

MAX_PROTOTYPES = 256


@dataclass(frozen=True)
class SceneRecord:
    """What stays known of a learned scene beside the head's weights."""

    name: str
    """Unique in a store."""
    camera: Camera
    """Intrinsics of its first training frame."""
    cell: Cell
    """Its place in the atlas."""
    prototypes: Tensor
    """(p, width) descriptors of training frames spread over the recording, half precision."""
    train_frames: int
    """Frames it was learned from."""
    refined_camera: Camera | None = None
    """`camera` as training corrected it, with distortion; None where the given one is trusted."""
    inlier_threshold: float = 0.0
    """Smallest inlier ratio of a pose that is believed; fitted on held-out training frames."""
    covariance_scale: float = 1.0
    """What covariances are multiplied with to match the errors on held-out training frames."""

    def lens(self, camera: Camera | None) -> Camera:
        """Intrinsics for a query: refined if the nominal ones or none are given, else as given."""
        own = self.camera
        if camera is None or (
            not camera.distortion
            and np.allclose(_proportions(camera), _proportions(own), atol=1e-3)
        ):
            return self.refined_camera or own
        return camera


def _proportions(camera: Camera) -> tuple[float, float, float, float]:
    w, h = camera.width, camera.height
    return camera.fx / w, camera.fy / h, (camera.cx + 0.5) / w, (camera.cy + 0.5) / h


def refine(camera: Camera, lens: Tensor) -> Camera:
    """A nominal pinhole with the correction (5,) that training found (see `reprojection_error`)."""
    focal, dx, dy, k1, k2 = (float(value) for value in lens)
    return Camera(
        camera.width,
        camera.height,
        camera.fx * (1 + focal),
        camera.fy * (1 + focal),
        camera.cx + dx * camera.fx,
        camera.cy + dy * camera.fy,
        (k1, k2, 0.0, 0.0),
    )


@dataclass
class Knowledge:
    """Everything that localization and the next stage need."""

    encoder: Encoder
    """Frozen local encoder."""
    descriptor: Descriptor
    """Frozen global descriptor."""
    strategy: str
    """Key of STRATEGIES."""
    short_side: int
    """Working size of images, pixels."""
    heads: list[Head] = field(default_factory=list)
    """One head, or one per scene."""
    scenes: list[SceneRecord] = field(default_factory=list)
    """In order of arrival; the index is the scene index of head and atlas."""
    memories: list[Memory | None] = field(default_factory=list)
    """What is remembered of each scene."""
    notes: list[Notes] = field(default_factory=list)
    """What the strategy noted about each scene (`continual.notes`)."""

    @property
    def memory_bytes(self) -> int:
        """Size of all that is kept for later stages: remembered frames and notes."""
        frames = sum(memory.bytes for memory in self.memories if memory is not None)
        return frames + sum(value.nbytes for note in self.notes for value in note.values())

    def atlas(self, grid_scenes: int = 0) -> Atlas:
        """Cells of the scenes known so far.

        Args:
            grid_scenes: of the paper's layout; 0 for the open one.
        """
        atlas = Atlas("paper", grid_scenes) if grid_scenes else Atlas()
        atlas.cells = [record.cell for record in self.scenes]
        return atlas

    def head_for(self, scene: int) -> tuple[Head, int]:
        """The head that answers for a scene and the scene's index in that head."""
        if len(self.heads) == 1 and self.heads[0].scenes > scene:
            return self.heads[0], scene
        return self.heads[scene], 0

    def fork(self) -> "Knowledge":
        """A copy whose heads may be trained without touching these."""
        return Knowledge(
            self.encoder,
            self.descriptor,
            self.strategy,
            self.short_side,
            copy.deepcopy(self.heads),
            list(self.scenes),
            list(self.memories),
            list(self.notes),
        )


def prototypes(descriptors: Tensor) -> Tensor:
    """At most 256 descriptors (n, width) spread evenly over a recording, half precision."""
    count = min(MAX_PROTOTYPES, len(descriptors))
    index = np.linspace(0, len(descriptors) - 1, count).round().astype(int)
    return descriptors[index].half()
