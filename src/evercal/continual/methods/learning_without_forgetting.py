"""Learning without forgetting: old answers are held on new images."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from evercal.continual.methods.method import Method, StageStart
from evercal.continual.methods.penalties import PX_PER_M
from evercal.continual.methods.replay import teacher_output
from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import Head, HeadOutput
from evercal.continual.networks.hooks import TrainingHooks


@dataclass(frozen=True)
class LearningWithoutForgetting(Method):
    """LwF for points: what the old scenes' outputs say about new images stays as it was.

    A step asks the head about rows of the new scene as if they showed an earlier one, and holds the
    points that the old head gave. That takes outputs of each scene's own (condition `code`); where
    the image alone decides which scene answers, old and new answers to the same row contradict one
    another.
    """

    citation: ClassVar[str] = "Li and Hoiem, Learning without forgetting, ECCV 2016"
    weight: float = 0.3
    """What the distance of each earlier scene is multiplied by."""
    px_per_m: float = PX_PER_M
    """Weight of the distance between old and new points, pixels per metre."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Distillation on new rows; nothing for the first scene."""
        if start.teacher is None:
            return TrainingHooks()
        return _OldAnswers(self, start.teacher, start.replay_rows)


class _OldAnswers(TrainingHooks):
    def __init__(self, method: LearningWithoutForgetting, teacher: Head, rows: int):
        self.method, self._teacher = method, teacher
        self._each = max(1, rows // teacher.scenes)

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: torch.Generator
    ) -> list[Rows]:
        """New rows once more, each part as if it showed another earlier scene."""
        parts = []
        for scene in range(self._teacher.scenes):
            size = len(fresh.scene), (self._each,)
            drawn = torch.randint(*size, generator=generator, device="cpu")
            part = fresh.part(drawn.to(fresh.scene.device))
            part.scene = torch.full_like(part.scene, scene)
            parts.append(part)
        return parts

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        old = teacher_output(self._teacher, rows)
        drift = (output.points - old.points).abs().sum(-1).mean()
        return self._teacher.scenes * self.method.weight * self.method.px_per_m * drift
