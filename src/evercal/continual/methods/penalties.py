"""What replaying remembered rows costs: small frozen dataclasses, one a rule."""

from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from evercal.continual.methods.spdd import SpddOptions, spdd_loss
from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.loss import LossOptions, fixed_clamp_loss, reprojection_loss

PX_PER_M = 50.0
"""Weight of a distance in scene coordinates, pixels per metre: about what a metre sideways is
in the image at 5 m."""


@dataclass(frozen=True)
class Penalty:
    """What a replayed row costs; a subclass says how."""

    needs_teacher: ClassVar[bool] = True
    """Whether the output of the head before the stage is needed, which costs a forward pass."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput | None, rows: Rows, tau_px: float
    ) -> Tensor:
        """Cost of replayed rows, pixels.

        Args:
            student: what the head says.
            teacher: what the head said before the stage; None unless `needs_teacher`.
            rows: the replayed rows.
            tau_px: soft clamp of the loss on new rows in this step, pixels.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Reprojection(Penalty):
    """Remembered rows cost what new ones cost, the schedule of the clamp included."""

    needs_teacher: ClassVar[bool] = False

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput | None, rows: Rows, tau_px: float
    ) -> Tensor:
        """Mean reprojection loss."""
        cost, _ = reprojection_loss(student.points, rows.target, tau_px, LossOptions())
        return cost.mean()


@dataclass(frozen=True)
class OldOutput(Penalty):
    """iCaRL for points: reprojection, and the L1 distance to the old model's points.

    Distillation of class scores becomes a distance in metres, on remembered rows only: what the old
    model says about rows of a new scene means nothing.
    """

    px_per_m: float = PX_PER_M
    """Weight of the distance, pixels per metre."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput | None, rows: Rows, tau_px: float
    ) -> Tensor:
        """Mean of both."""
        assert teacher is not None
        drift = (student.points - teacher.points.detach()).abs().sum(-1).mean()
        return Reprojection()(student, None, rows, tau_px) + self.px_per_m * drift


@dataclass(frozen=True)
class BoundedByTeacher(Penalty):
    """Buff-CS: half the truth, half the teacher where the teacher is nearer to the truth.

    The teacher is the model before the stage, where the original stores its outputs when a frame
    enters the buffer.
    """

    px_per_m: float = PX_PER_M
    """Weight of the distance to the teacher's points, pixels per metre."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput | None, rows: Rows, tau_px: float
    ) -> Tensor:
        """Mean of both halves."""
        assert teacher is not None
        _, error = fixed_clamp_loss(student.points, rows.target)
        _, bound = fixed_clamp_loss(teacher.points, rows.target)
        drift = (student.points - teacher.points.detach()).abs().sum(-1)
        pulled = torch.where(error > bound, drift, torch.zeros_like(drift)).mean()
        truth = Reprojection()(student, None, rows, tau_px)
        return 0.5 * truth + 0.5 * self.px_per_m * pulled


@dataclass(frozen=True)
class StoredOutput(Penalty):
    """DER++ for points: half the truth, half what was said when the scene was learned.

    The stored points belong to remembered frames as they are; augmented views have the truth alone.
    """

    needs_teacher: ClassVar[bool] = False
    px_per_m: float = PX_PER_M
    """Weight of the distance to the stored points, pixels per metre."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput | None, rows: Rows, tau_px: float
    ) -> Tensor:
        """Mean of both halves."""
        assert rows.stored is not None, "the method stores points when a scene is finished"
        kept = ~rows.stored[:, 0].isnan()
        drift = (student.points[kept] - rows.stored[kept]).abs().sum(-1)
        held = drift.sum() / max(len(drift), 1)
        truth = Reprojection()(student, None, rows, tau_px)
        return 0.5 * truth + 0.5 * self.px_per_m * held


@dataclass(frozen=True)
class Relations(Penalty):
    """Co2L for points: the truth, and how alike rows are to one another.

    The instance-wise relation distillation of Cha et al. (ICCV 2021): the Kullback-Leibler
    divergence between softmaxed similarities of the old model's features and of the new one's, at
    one temperature, so that agreement is free. Its contrastive loss takes classes and has no
    counterpart.
    """

    related_rows: int = 512
    """Rows that are compared with one another, spread over all remembered scenes."""
    temperature: float = 0.2
    """Of the softmax over cosines (no unit)."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput | None, rows: Rows, tau_px: float
    ) -> Tensor:
        """Mean reprojection loss and the divergence, nats."""
        assert teacher is not None
        # Rows come scene by scene; the first ones alone would all be of the oldest scene.
        count = len(student.hidden)
        few, where = min(count, self.related_rows), student.hidden.device
        chosen = torch.linspace(0, count - 1, few, device=where).round().long()

        def similarity(hidden: Tensor) -> Tensor:
            unit = torch.nn.functional.normalize(hidden[chosen], dim=-1)
            others = ~torch.eye(len(unit), dtype=torch.bool, device=unit.device)
            logits = (unit @ unit.T / self.temperature)[others].view(len(unit), -1)
            return logits.log_softmax(-1)

        old, new = similarity(teacher.hidden.detach()), similarity(student.hidden)
        moved = (old.exp() * (old - new)).sum(-1).mean()
        return Reprojection()(student, None, rows, tau_px) + moved


@dataclass(frozen=True)
class AnchoredReprojection(Penalty):
    """Geometric truth, and the teacher's points where they were right.

    Reprojection against the known poses with a tight, fixed clamp corrects itself, so errors do not
    pile up from stage to stage. The L1 distance to the teacher's point holds the depth, which a
    single reprojection does not see; it counts only where the teacher was right (after Buff-CS's
    teacher-bounded regression, Wang et al., ICCV 2021).
    """

    clamp_px: float = 5.0
    """Soft clamp of the reprojection error, pixels."""
    px_per_m: float = PX_PER_M
    """Weight of the distance to the teacher's points, pixels per metre."""
    teacher_limit_px: float = 10.0
    """The teacher is right where it reprojects within so many pixels."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput | None, rows: Rows, tau_px: float
    ) -> Tensor:
        """Mean of both."""
        assert teacher is not None
        cost, _ = fixed_clamp_loss(student.points, rows.target, self.clamp_px)
        _, error = fixed_clamp_loss(teacher.points, rows.target, self.clamp_px)
        drift = (student.points - teacher.points.detach()).abs().sum(-1)
        held = torch.where(error < self.teacher_limit_px, drift, torch.zeros_like(drift))
        return cost.mean() + self.px_per_m * held.mean()


@dataclass(frozen=True)
class Distillation(Penalty):
    """SPDD, the whole replay cost of the paper (Algorithm 2): no truth, the teacher alone.

    Its terms are in nats and metres. The paper adds them up as they are; `scale` says how many
    pixels of the loss on new rows one of them is worth.
    """

    options: SpddOptions = field(default_factory=SpddOptions)
    """Weights of the three terms, temperature and active set."""
    scale: float = 1.0
    """Pixels per metre and per nat; 1 is the paper's."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput | None, rows: Rows, tau_px: float
    ) -> Tensor:
        """The weighted sum of the three terms."""
        assert teacher is not None
        return self.scale * spdd_loss(student, teacher, self.options).total
