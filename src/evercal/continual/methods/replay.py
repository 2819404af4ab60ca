"""Experience replay: rows of remembered keyframes join every step with a loss of their own.

Most methods differ only in the selected frames and the loss of replayed rows; both are fields.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from evercal.continual.methods.method import Method, StageStart
from evercal.continual.methods.penalties import Penalty, Reprojection
from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import Head, HeadOutput
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.networks.precision import autocast
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.continual.selection.selectors import SELECTORS


@dataclass(frozen=True)
class EpisodicMemory(Method):
    """Base of methods that use keyframes during training."""

    replays: ClassVar[bool] = True
    selector: str = "reservoir"
    """Rule that selects the keyframes: a key of SELECTORS."""

    def select(self, frames: FrameStatistics, capacity: int) -> np.ndarray | None:
        """Apply the selector."""
        return SELECTORS[self.selector](frames, capacity)


class MemoryHooks(TrainingHooks):
    """Draws the same number of rows from each remembered scene, at least one."""

    def __init__(self, start: StageStart):
        self.memories = start.memories
        self.each = max(1, start.replay_rows // len(start.memories))

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: torch.Generator
    ) -> list[Rows]:
        """Draw rows of each remembered scene."""
        return [memory.draw(self.each, generator) for memory in self.memories]


@dataclass(frozen=True)
class Replay(EpisodicMemory):
    """Replays keyframes (Chaudhry et al., On tiny episodic memories, 2019)."""

    citation: ClassVar[str] = (
        "Vitter 1985; Chaudhry et al., On tiny episodic memories, 2019"
    )
    penalty: Penalty = field(default_factory=Reprojection)
    weight: float = 1.0
    """Weight of the penalty, the mean over the rows of all remembered scenes."""
    every_scene: bool = False
    """Multiply the weight by the number of remembered scenes; the paper has one for all of them."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Replay from the stage's memories, from the second scene on."""
        return ReplayHooks(self, start) if start.memories else TrainingHooks()


class ReplayHooks(MemoryHooks):
    """Adds the penalty of the replayed rows."""

    def __init__(self, method: Replay, start: StageStart):
        super().__init__(start)
        self.method = method
        self._teacher = start.teacher if method.penalty.needs_teacher else None

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        """Compute the weighted penalty."""
        teacher = None if self._teacher is None else teacher_output(self._teacher, rows)
        scenes = len(self.memories) if self.method.every_scene else 1
        penalty = self.method.penalty(output, teacher, rows, tau_px)
        return scenes * self.method.weight * penalty


def teacher_output(teacher: Head, rows: Rows) -> HeadOutput:
    """Apply a frozen head to rows."""
    with torch.no_grad(), autocast(rows.features.device):
        return teacher(rows.features.float(), rows.scene, rows.descriptor)
