"""Experience replay: rows of remembered keyframes join every step with a loss of their own.

Most methods differ only in the selected frames and the loss of replayed rows; both are fields.
"""

from dataclasses import field

import torch
from torch import Generator, Tensor

from evercal.classes import frozen
from evercal.continual.methods.method import Method, StageStart
from evercal.continual.methods.penalties import (
    Penalty,
    Reprojection,
)
from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import Head, HeadOutput
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.networks.precision import autocast
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.continual.selection.selectors import SELECTORS
from evercal.typing import IntArray


@frozen
class EpisodicMemory(Method):
    """Base of methods that use keyframes during training."""

    replays = True
    selector: str = "reservoir"
    """Rule that selects the keyframes: a key of SELECTORS."""

    def select(self, frames: FrameStatistics, capacity: int) -> IntArray | None:
        """Apply the selector."""
        return SELECTORS[self.selector](frames, capacity)

    def begin(self, start: StageStart) -> TrainingHooks:
        """Use the keyframes from the second scene on."""
        if not start.memories:
            return TrainingHooks()
        return self.hooks(start)

    def hooks(self, start: StageStart) -> TrainingHooks:
        """Create the hooks of a stage that has remembered scenes."""
        raise NotImplementedError


class MemoryHooks(TrainingHooks):
    """Draws the same number of rows from each remembered scene, at least one."""

    def __init__(self, start: StageStart):
        self.memories = start.memories
        self.each = max(1, start.replay_rows // len(start.memories))

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: Generator
    ) -> list[Rows]:
        """Draw rows of each remembered scene."""
        return [memory.draw(self.each, generator) for memory in self.memories]


@frozen
class Replay(EpisodicMemory):
    """Replays keyframes (Chaudhry et al., On tiny episodic memories, 2019)."""

    weight_field = "weight"
    penalty: Penalty = field(default_factory=Reprojection)
    """Loss of the replayed rows."""
    weight: float = 1.0
    """Weight of the penalty, the mean over the rows of all remembered scenes."""

    def hooks(self, start: StageStart) -> TrainingHooks:
        """Replay from the stage's memories."""
        return ReplayHooks(self, start)


class ReplayHooks(MemoryHooks):
    """Adds the penalty of the replayed rows."""

    def __init__(self, method: Replay, start: StageStart):
        super().__init__(start)
        self.method = method
        self._teacher = start.teacher

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        """Compute the weighted penalty."""
        method = self.method
        old_output = output
        if method.penalty.needs_teacher and self._teacher:
            old_output = teacher_output(self._teacher, rows)
        return method.weight * method.penalty(output, old_output, rows, tau_px)


def teacher_output(teacher: Head, rows: Rows) -> HeadOutput:
    """Apply a frozen head to rows."""
    with torch.no_grad(), autocast(rows.features.device):
        return teacher(rows.features.float(), rows.scene, rows.descriptor)
