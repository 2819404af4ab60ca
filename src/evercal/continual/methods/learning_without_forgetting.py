"""Learning without forgetting: distillation of the old head on new images."""

import torch
from torch import Generator, Tensor

from evercal.classes import frozen
from evercal.continual.methods.method import Method, StageStart
from evercal.continual.methods.penalties import PX_PER_M
from evercal.continual.methods.replay import teacher_output
from evercal.continual.networks.buffer import Rows, random_indices
from evercal.continual.networks.head import Head, HeadOutput
from evercal.continual.networks.hooks import TrainingHooks


@frozen
class LearningWithoutForgetting(Method):
    """LwF for points: new rows with the code of an old scene keep the output of the old head.

    Each step applies the head to rows of the new scene with the code of every earlier scene. The
    loss is the distance to the points of the old head. This requires outputs per scene (condition
    `code`); with condition `descriptor`, old and new targets of a row contradict each other.
    """

    citation = "Li and Hoiem, Learning without forgetting, ECCV 2016"
    weight_field = "weight"
    weight: float = 0.3
    """Weight of each earlier scene's distance."""
    px_per_m: float = PX_PER_M
    """Weight of the distance between old and new points, pixels per metre."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Distil on new rows, from the second scene on."""
        if not start.teacher:
            return TrainingHooks()
        return _DistillationHooks(self, start.teacher, start.replay_rows)


class _DistillationHooks(TrainingHooks):
    def __init__(self, method: LearningWithoutForgetting, teacher: Head, rows: int):
        self.method = method
        self._teacher = teacher
        self._rows_of_scene = max(1, rows // teacher.scenes)

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: Generator
    ) -> list[Rows]:
        # New rows once more, one part with the index of each earlier scene.
        replayed = []
        for scene in range(self._teacher.scenes):
            drawn = random_indices(len(fresh.scene), self._rows_of_scene, generator)
            rows = fresh.part(drawn.to(fresh.scene.device))
            rows.scene = torch.full_like(rows.scene, scene)
            replayed.append(rows)
        return replayed

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        old = teacher_output(self._teacher, rows)
        drift = (output.points - old.points).abs().sum(-1).mean()
        method = self.method
        return self._teacher.scenes * method.weight * method.px_per_m * drift
