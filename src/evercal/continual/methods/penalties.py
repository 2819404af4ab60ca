"""Losses of replayed rows, each a small frozen dataclass."""

from dataclasses import field
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from evercal.classes import frozen
from evercal.continual.methods.spdd import SpddOptions, spdd_loss
from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.loss import (
    LossOptions,
    fixed_clamp_loss,
    reprojection_loss,
    surface_loss,
)

PX_PER_M = 50.0
"""Weight of a distance in scene coordinates, pixels per metre. One metre sideways at a depth of 5 m
is about as many pixels in the image."""


@frozen
class Penalty:
    """Loss of replayed rows; subclasses implement it."""

    needs_teacher: ClassVar[bool] = True
    """Whether the output of the head before the stage is needed (one more forward pass); without it
    `teacher` may be any."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput, rows: Rows, tau_px: float
    ) -> Tensor:
        """Compute the loss in pixels; `tau_px` is the soft clamp of new rows in this step."""
        raise NotImplementedError


def _distance_m(student: HeadOutput, teacher: HeadOutput) -> Tensor:
    return (student.points - teacher.points.detach()).abs().sum(-1)


def _reprojection(student: HeadOutput, rows: Rows, tau_px: float) -> Tensor:
    loss, _ = reprojection_loss(student.points, rows.target, tau_px, LossOptions())
    return loss.mean()


@frozen
class Reprojection(Penalty):
    """The reprojection loss of new rows, with the same schedule of the clamp."""

    needs_teacher = False

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput, rows: Rows, tau_px: float
    ) -> Tensor:
        """Compute the loss in pixels."""
        return _reprojection(student, rows, tau_px)


@frozen
class OldOutput(Penalty):
    """iCaRL for points: reprojection loss plus L1 distance to the old model's points.

    The distillation of class scores becomes a distance in metres. It applies to remembered rows
    only, because the old model's output for rows of a new scene is arbitrary.
    """

    px_per_m: float = PX_PER_M
    """Weight of the distance, pixels per metre."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput, rows: Rows, tau_px: float
    ) -> Tensor:
        """Compute the loss in pixels."""
        distance = _distance_m(student, teacher).mean()
        return _reprojection(student, rows, tau_px) + self.px_per_m * distance


@frozen
class BoundedByTeacher(Penalty):
    """Buff-CS: reprojection loss, and distance to the teacher where the teacher is more accurate.

    The teacher is the model before the stage. The original stores its output when a frame enters
    the buffer.
    """

    px_per_m: float = PX_PER_M
    """Weight of the distance to the teacher's points, pixels per metre."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput, rows: Rows, tau_px: float
    ) -> Tensor:
        """Compute the loss in pixels."""
        _, error = fixed_clamp_loss(student.points, rows.target)
        _, bound = fixed_clamp_loss(teacher.points, rows.target)
        distance = _distance_m(student, teacher)
        bounded = torch.where(error > bound, distance, 0.0).mean()
        reprojection = _reprojection(student, rows, tau_px)
        return 0.5 * reprojection + 0.5 * self.px_per_m * bounded


@frozen
class Relations(Penalty):
    """Co2L for points: reprojection loss, and similarity between rows.

    The instance-wise relation distillation of Cha et al. (ICCV 2021) is the Kullback-Leibler
    divergence between softmaxed feature similarities of the old and the new model. Here both have
    one temperature, so equal models have no loss. The contrastive loss is omitted, because it needs
    classes.
    """

    related_rows: int = 512
    """Rows that are compared with each other, evenly from all remembered scenes."""
    temperature: float = 0.2
    """Temperature of the softmax over cosines (no unit)."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput, rows: Rows, tau_px: float
    ) -> Tensor:
        """Compute the loss in pixels."""
        # Rows are ordered by scene, so an even spacing covers all scenes.
        count = len(student.hidden)
        compared = min(count, self.related_rows)
        device = student.hidden.device
        index = torch.linspace(0, count - 1, compared, device=device).round().long()
        others = ~torch.eye(compared, dtype=torch.bool, device=device)

        def similarity(hidden: Tensor) -> Tensor:
            unit = F.normalize(hidden[index], dim=-1)
            cosines = unit @ unit.T / self.temperature
            return cosines[others].view(compared, -1).log_softmax(-1)

        old = similarity(teacher.hidden.detach())
        new = similarity(student.hidden)
        divergence = (old.exp() * (old - new)).sum(-1).mean()
        return _reprojection(student, rows, tau_px) + divergence


@frozen
class OldPixels(Penalty):
    """Reprojection loss, and distance to the teacher's points in pixels at their depth.

    A metre counts as much as it moves the image, unlike in SPDD, iCaRL and Buff-CS. So distance and
    reprojection have one unit, and half of each needs no further weight.
    """

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput, rows: Rows, tau_px: float
    ) -> Tensor:
        """Compute the loss in pixels."""
        known = teacher.points.detach()
        distance = surface_loss(student.points, known, rows.target, tau_px)
        return 0.5 * distance.mean() + 0.5 * _reprojection(student, rows, tau_px)


@frozen
class Distillation(Penalty):
    """SPDD, the complete replay loss of the paper (Algorithm 2), without reprojection.

    Its terms are in nats and metres, which the paper adds without units.
    """

    options: SpddOptions = field(default_factory=SpddOptions)
    """Weights of the three terms, temperature and active set."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput, rows: Rows, tau_px: float
    ) -> Tensor:
        """Compute the loss in metres and nats."""
        return spdd_loss(student, teacher, self.options)
