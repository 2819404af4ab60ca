"""Penalties: what replaying remembered rows costs."""

from collections.abc import Callable

import torch
from torch import Tensor

from evercal.continual.methods.spdd import SpddOptions, spdd_loss
from evercal.networks.buffer import Rows
from evercal.networks.head import HeadOutput
from evercal.networks.loss import LossOptions, clamp_px, fixed_clamp_loss, reprojection_loss

Penalty = Callable[[HeadOutput, HeadOutput, Rows, float], Tensor]
"""What replay costs: (student, frozen teacher, replayed rows, progress in [0, 1]) -> scalar."""

REPLAY_CLAMP_PX = 5.0
TEACHER_LIMIT_PX = 10.0
OUTPUT_WEIGHT_PX_PER_M = 50.0
REPLAY_WEIGHT = 0.5
RELATED_ROWS = 512
RELATION_TEMPERATURE = 0.2


def spdd(student: HeadOutput, teacher: HeadOutput, rows: Rows, progress: float) -> Tensor:
    """Replay of the paper: its three distillations (see `methods.spdd`), and no truth."""
    return spdd_loss(student, teacher, SpddOptions()).total


def reprojection(student: HeadOutput, teacher: HeadOutput, rows: Rows, progress: float) -> Tensor:
    """Plain experience replay: remembered rows cost what new ones cost, the schedule included."""
    options = LossOptions()
    tau = clamp_px(options, progress)
    cost, _ = reprojection_loss(student.points, rows.target, tau, options)
    return cost.mean()


def old_output(student: HeadOutput, teacher: HeadOutput, rows: Rows, progress: float) -> Tensor:
    """Replay of iCaRL for points: what new rows cost, and the distance to the old model's points.

    Distillation of class scores becomes L1 in metres, on remembered rows only: what the old model
    says about rows of a new scene means nothing.
    """
    drift = (student.points - teacher.points.detach()).abs().sum(-1).mean()
    return reprojection(student, teacher, rows, progress) + OUTPUT_WEIGHT_PX_PER_M * drift


def bounded_by_teacher(
    student: HeadOutput, teacher: HeadOutput, rows: Rows, progress: float
) -> Tensor:
    """Replay of Buff-CS: half the truth, half the teacher where it is nearer to the truth.

    The teacher is the model before the stage, where the original stores its outputs when a frame
    enters the buffer.
    """
    _, error = fixed_clamp_loss(student.points, rows.target)
    _, bound = fixed_clamp_loss(teacher.points, rows.target)
    drift = (student.points - teacher.points.detach()).abs().sum(-1)
    pulled = torch.where(error > bound, drift, torch.zeros_like(drift)).mean()
    truth = reprojection(student, teacher, rows, progress)
    return 0.5 * truth + 0.5 * OUTPUT_WEIGHT_PX_PER_M * pulled


def fixed_clamp_reprojection(
    student: HeadOutput, teacher: HeadOutput, rows: Rows, progress: float
) -> Tensor:
    """Reprojection with a fixed clamp, for rules that compare losses of different times."""
    cost, _ = fixed_clamp_loss(student.points, rows.target)
    return cost.mean()


def stored_output(student: HeadOutput, teacher: HeadOutput, rows: Rows, progress: float) -> Tensor:
    """Replay of DER++ for points: half the truth, half what was said when the scene was learned.

    The stored points belong to remembered frames as they are; augmented views have the truth alone.
    """
    assert rows.stored is not None, "strategies with this penalty note their points"
    kept = ~rows.stored[:, 0].isnan()
    drift = (student.points[kept] - rows.stored[kept]).abs().sum(-1)
    held = drift.sum() / max(len(drift), 1)
    truth = reprojection(student, teacher, rows, progress)
    return 0.5 * truth + 0.5 * OUTPUT_WEIGHT_PX_PER_M * held


def relations(student: HeadOutput, teacher: HeadOutput, rows: Rows, progress: float) -> Tensor:
    """Replay of Co2L for points: the truth, and how alike rows are to one another.

    The instance-wise relation distillation of Cha et al. (ICCV 2021): the Kullback-Leibler
    divergence between softmaxed similarities of the old model's features and of the new one's, at
    one temperature, so that agreement is free. Its contrastive loss takes classes and has no
    counterpart.
    """

    def similarity(hidden: Tensor) -> Tensor:
        unit = torch.nn.functional.normalize(hidden[:RELATED_ROWS], dim=-1)
        others = ~torch.eye(len(unit), dtype=torch.bool)
        logits = (unit @ unit.T / RELATION_TEMPERATURE)[others].view(len(unit), -1)
        return logits.log_softmax(-1)

    old, new = similarity(teacher.hidden.detach()), similarity(student.hidden)
    moved = (old.exp() * (old - new)).sum(-1).mean()
    return reprojection(student, teacher, rows, progress) + moved


def anchored_reprojection(
    student: HeadOutput, teacher: HeadOutput, rows: Rows, progress: float
) -> Tensor:
    """Replay of `evercal`: geometric truth, and the teacher's points where they were right.

    Reprojection against the known poses with a tight, fixed clamp corrects itself, so errors do not
    pile up from stage to stage. The L1 distance to the teacher's point (weight 50 px per metre,
    about the parallax of a pixel at 3 m) holds the depth, which a single reprojection does not
    see; it counts only where the teacher reprojects within 10 px (after Buff-CS's teacher-bounded
    regression, Wang et al., ICCV 2021).
    """
    options = LossOptions()
    cost, _ = reprojection_loss(student.points, rows.target, REPLAY_CLAMP_PX, options)
    _, error = reprojection_loss(teacher.points, rows.target, REPLAY_CLAMP_PX, options)
    drift = (student.points - teacher.points.detach()).abs().sum(-1)
    held = torch.where(error < TEACHER_LIMIT_PX, drift, torch.zeros_like(drift))
    return REPLAY_WEIGHT * (cost.mean() + OUTPUT_WEIGHT_PX_PER_M * held.mean())
