"""A continual-learning method: how scenes that come one after another share a network.

A method is a frozen dataclass; its fields are its hyper-parameters, which results record. What it
does is told by four functions: which keyframes stay, what is added to the training of a new scene,
what is kept beside the keyframes, and whether the head is shared.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import ClassVar

import numpy as np
from torch import Tensor

from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.networks.buffer import FeatureBuffer, Rows
from evercal.continual.networks.head import Head, HeadOutput
from evercal.continual.networks.hooks import TrainingHooks

MethodState = Mapping[str, Tensor]
"""What a method keeps of a finished scene beside its keyframes: named tensors, stored with the
scene and counted as memory."""


@dataclass(frozen=True)
class StageStart:
    """A scene is about to be learned."""

    head: Head
    """To be trained, with room for the new scene."""
    teacher: Head | None
    """A frozen copy as it was before; None for the first scene."""
    memories: Sequence[FeatureBuffer]
    """Rows of the keyframes of each remembered scene; empty if the method does not replay."""
    states: Sequence[MethodState]
    """Of all earlier scenes in order."""
    replay_rows: int
    """Rows to replay in a step, of all remembered scenes together."""
    seed: int
    """Random seed."""


@dataclass(frozen=True)
class FinishedScene:
    """A scene was just learned."""

    head: Head
    """As it is now."""
    number: int
    """The scene's index in the head."""
    rows: Callable[[], FeatureBuffer]
    """Rows of the scene's training frames."""
    remembered: Callable[[], FeatureBuffer]
    """Rows of the keyframes that stay, as they will be replayed: the plain views come first."""
    keyframes: int
    """How many keyframes stay, and plain views those rows begin with."""
    earlier: Sequence[MethodState]
    """Of all earlier scenes in order."""
    hooks: TrainingHooks | None
    """Those of the stage; None where the scene was learned by plain training."""
    diffusion: float = 0.0
    """Noise on the descriptors of rows as they are replayed; 0 where the head sees none."""

    def output(self, rows: Rows) -> HeadOutput:
        """What the head says now about rows of this scene."""
        return self.head(rows.features.float(), self.number, rows.descriptor)


@dataclass(frozen=True)
class Method:
    """Trains on the new scene alone and keeps nothing, unless a subclass says otherwise."""

    citation: ClassVar[str] = ""
    """Where the rule comes from."""
    replays: ClassVar[bool] = False
    """Whether rows of remembered keyframes are needed while a scene is learned."""
    head_per_scene: ClassVar[bool] = False
    """Whether every scene gets a head of its own."""
    first_scene_alike: ClassVar[bool] = True
    """Whether the first scene is learned as any other method would."""

    def select(self, frames: FrameStatistics, capacity: int) -> np.ndarray | None:
        """Indices, in recorded order, of the frames that stay in memory; None keeps none."""
        return None

    def begin(self, start: StageStart) -> TrainingHooks:
        """What is added to the training of a new scene."""
        return TrainingHooks()

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """What is kept of a finished scene beside its keyframes."""
        return {}

    def needed(self, states: Sequence[MethodState]) -> Sequence[MethodState]:
        """Those of the states so far that later stages look at, and that count as memory."""
        return states


def described(record: object) -> dict[str, object]:
    """A dataclass as plain data: its class under `kind`, and its fields."""
    assert is_dataclass(record)
    found: dict[str, object] = {"kind": type(record).__name__}
    for field in fields(record):
        value = getattr(record, field.name)
        found[field.name] = described(value) if is_dataclass(value) else value
    return found
