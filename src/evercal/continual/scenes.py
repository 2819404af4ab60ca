"""What a robot with networks has learned: heads, remembered keyframes and a record per scene."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from evercal.classes import frozen
from evercal.continual.networks.atlas import Atlas, Cell
from evercal.continual.networks.descriptor import Descriptor
from evercal.continual.networks.device import device_of_network
from evercal.continual.networks.head import Head
from evercal.features.encoder import Encoder
from evercal.geometry import Camera, spread
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.map_frame import MapFrame

MAX_PROTOTYPES = 256
"""Maximum number of descriptors that are stored of a scene."""


@frozen
class SceneRecord:
    """A learned scene, without the weights of the head."""

    name: str
    """Unique in a store."""
    camera: Camera
    """Intrinsics of its first training frame."""
    cell: Cell
    """Its place in the atlas."""
    prototypes: Tensor
    """(p, width) descriptors of training frames spread over the recording, half precision."""
    train_frames: int
    """Number of training frames."""
    inlier_threshold: float = 0.0
    """Poses with a smaller inlier ratio are rejected; fitted to held-out training frames."""
    covariance_scale: float = 1.0
    """Factor on covariances, fitted to held-out training frames."""

    @property
    def adjusted_camera(self) -> Camera:
        """Intrinsics for images of the camera that recorded the scene: the stated ones."""
        return self.camera

    @property
    def frame(self) -> MapFrame:
        """Relation of its scene points to the base frame: none, networks learn stated poses."""
        return MapFrame()


@dataclass
class LearnedScenes:
    """Everything that localization and the next stage need."""

    encoder: Encoder
    """Network of local features."""
    descriptor: Descriptor
    """Network of global descriptors."""
    strategy: str
    """Key of STRATEGIES."""
    short_side: int
    """Working size of images, pixels."""
    heads: list[Head] = field(default_factory=list)
    """One head, or one per scene."""
    scenes: list[SceneRecord] = field(default_factory=list)
    """In order of arrival; the index is the scene index of head and atlas."""
    keyframes: list[Keyframes | None] = field(default_factory=list)
    """Remembered keyframes of each scene; None for strategies without memory."""
    method_states: list[Mapping[str, Tensor]] = field(default_factory=list)
    """Named tensors that the method keeps of each scene."""
    cache: Path | None = None
    """Folder of features and depths that runs over the same frames share; not stored."""

    @property
    def device(self) -> torch.device:
        """Device of the networks; images are encoded on the CPU."""
        return device_of_network(self.descriptor)

    def to(self, device: torch.device) -> Self:
        """Move descriptor and heads to a device, in place; all else stays on the CPU."""
        for network in (self.descriptor, *self.heads):
            network.to(device)
        return self

    @property
    def memory_bytes(self) -> int:
        """Size of the memory for later stages: keyframes and method states."""
        size = 0
        for keyframes in self.keyframes:
            if keyframes is not None:
                size += keyframes.bytes
        for state in self.method_states:
            size += sum(value.nbytes for value in state.values())
        return size

    @property
    def frames_kept(self) -> int:
        """Keyframes of the newest scene."""
        return len(self.keyframes[-1] or ())

    def atlas(self, grid_scenes: int = 0) -> Atlas:
        """Cells of the scenes learned so far; `grid_scenes` of the paper's layout, 0: open."""
        return Atlas(grid_scenes, [record.cell for record in self.scenes])

    def head_for(self, scene: int) -> tuple[Head, int]:
        """The head of a scene and the scene's index in that head."""
        if len(self.heads) == 1 and self.heads[0].scenes > scene:
            return self.heads[0], scene
        return self.heads[scene], 0

    def copy_for_training(self) -> Self:
        """A copy whose heads can be trained without changing these."""
        return replace(
            self,
            heads=copy.deepcopy(self.heads),
            scenes=list(self.scenes),
            keyframes=list(self.keyframes),
            method_states=list(self.method_states),
        )


def prototypes(descriptors: Tensor) -> Tensor:
    """At most 256 of (n, width) descriptors, spread over a recording; half precision, CPU."""
    index = spread(len(descriptors), MAX_PROTOTYPES)
    return descriptors[index].half().cpu()
