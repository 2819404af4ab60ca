"""The interface of a continual-learning method.

A method is a frozen dataclass whose fields are its hyper-parameters; results record them. Functions
select the keyframes, extend the training of a new scene, and compute what is stored beside the
keyframes.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import ClassVar, Self

from torch import Tensor

from evercal.classes import frozen
from evercal.continual.networks.buffer import FeatureBuffer, Rows
from evercal.continual.networks.head import Head, HeadOutput
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.typing import IntArray, JsonObject

MethodState = Mapping[str, Tensor]
"""Named tensors that a method stores with a finished scene; they count as memory."""


@frozen
class StageStart:
    """Inputs of a method before a scene is learned."""

    head: Head
    """Head to train, already grown by the new scene."""
    teacher: Head | None
    """Frozen copy of the head before the stage; None for the first scene."""
    memories: Sequence[FeatureBuffer]
    """Rows of the keyframes of each remembered scene; empty if the method does not replay."""
    states: Sequence[MethodState]
    """States of all earlier scenes in order."""
    replay_rows: int
    """Rows to replay in a step, for all remembered scenes together."""


@frozen
class FinishedScene:
    """Inputs of a method after a scene was learned."""

    head: Head
    """Head after the training of the scene."""
    number: int
    """Index of the scene in the head."""
    rows: Callable[[], FeatureBuffer]
    """Returns the rows of the scene's training frames."""
    remembered: Callable[[], FeatureBuffer]
    """Returns the rows of the scene's keyframes as they will be replayed."""
    diffusion: float = 0.0
    """Noise on the descriptors of replayed rows; 0 if the head has no descriptor input."""

    def output(self, rows: Rows) -> HeadOutput:
        """Apply the head to rows of this scene."""
        return self.head(rows.features.float(), self.number, rows.descriptor)


@frozen
class Method:
    """Base of all methods: trains on the new scene alone and stores nothing."""

    replays: ClassVar[bool] = False
    """Whether training needs the rows of remembered keyframes."""
    head_per_scene: ClassVar[bool] = False
    """Whether every scene has a head of its own."""
    weight_field: ClassVar[str] = ""
    """Field that weights what protects earlier scenes; empty without one."""

    def weighted(self, weight: float) -> Self:
        """Copy the method with another weight of what protects earlier scenes."""
        return replace(self, **{self.weight_field: weight})

    def select(self, frames: FrameStatistics, capacity: int) -> IntArray | None:
        """Select the keyframes: sorted indices into the recorded frames, or None for no memory."""
        return None

    def begin(self, start: StageStart) -> TrainingHooks:
        """Create the hooks for the training of a new scene."""
        return TrainingHooks()

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Compute what is stored beside the keyframes of a finished scene."""
        return {}


@frozen
class FineTuning(Method):
    """Trains on each new scene from the weights after the last one."""


@frozen
class Isolation(Method):
    """A head per scene, after ESAC (Brachmann and Rother, ICCV 2019); scenes share no weights."""

    head_per_scene = True


def described(record: object) -> JsonObject:
    """Convert a dataclass to data of JSON: its class name as `kind`, and its fields."""
    assert is_dataclass(record)
    plain: JsonObject = {"kind": type(record).__name__}
    for field in fields(record):
        value = getattr(record, field.name)
        if is_dataclass(value):
            value = described(value)
        plain[field.name] = value
    return json.loads(json.dumps(plain, default=str))  # a plugin may have a Path
