"""SPDD, structure-preserving dual distillation (Algorithm 2 of the paper).

SPDD is the complete replay loss of the paper; it contains no reprojection error. Every term is
summed over active centres and coordinates and averaged over rows.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from evercal.continual.networks.head import HeadOutput


@dataclass(frozen=True)
class SpddOptions:
    """Weights and settings of the distillation loss; the defaults are the paper's."""

    prior_weight: float = 1.0
    """Weight alpha of the term on centre probabilities (per nat)."""
    metric_weight: float = 1.0
    """Weight beta of the term on offsets (per metre)."""
    output_weight: float = 1.0
    """Weight gamma of the term on scene coordinates (per metre)."""
    temperature: float = 2.0
    """Softmax temperature tau of the prior term (no unit)."""
    active_centres: int = 50
    """Largest number M_a of active centres per row."""

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("prior_weight", "metric_weight", "output_weight"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"SpddOptions.{name} is {value}; give a finite number >= 0")
        if not (math.isfinite(self.temperature) and self.temperature > 0):
            raise ValueError(f"SpddOptions.temperature is {self.temperature}; give a number > 0")
        if self.active_centres < 1:
            raise ValueError(f"SpddOptions.active_centres is {self.active_centres}; give >= 1")


@dataclass(frozen=True)
class SpddTerms:
    """The terms of the loss, each a scalar without its weight, and their weighted sum."""

    prior: Tensor
    """Divergence of centre probabilities, nats."""
    metric: Tensor
    """Distance of offsets, metres."""
    output: Tensor
    """Distance of points, metres."""
    total: Tensor
    """Weighted sum."""


def spdd_loss(student: HeadOutput, teacher: HeadOutput, options: SpddOptions) -> SpddTerms:
    """Compute the distillation loss of a student against a teacher on the same rows.

    The active set A of a row contains its M_a highest teacher logits. A centre that either head
    masks (logit -inf) is never active. The terms are

    - prior: ``tau^2 KL(p_T || p_S)``. The teacher's softmax ``p_T`` is over A. The student's
      softmax ``p_S`` is over A and over the centres N that the teacher does not have. With s the
      student's probability of A within A and N, this equals the paper's term plus
      ``-tau^2 log s``, which lowers the logits of new centres on old rows. Without new centres it
      is the paper's term. Old centres outside A are free, as in the paper.
    - metric: ``|Delta_S - Delta_T|`` at A with per-centre offsets, or of the single shared offset.
    - output: ``|x_S - x_T|``.

    Centre k of the teacher is centre k of the student; new centres follow. A row without active
    centres has no prior term, and no metric term with per-centre offsets. NaN propagates.

    Args:
        student: Output with gradients, K_student >= K_teacher centres.
        teacher: Output for the same rows; detached here.
        options: Weights, temperature and size of the active set.

    Raises:
        ValueError: The shapes are inconsistent.
    """
    shared = _check_shapes(student, teacher)
    rows, old = teacher.logits.shape
    teacher_logits = teacher.logits.detach()
    masked = torch.isneginf(teacher_logits) | torch.isneginf(student.logits.detach()[:, :old])
    count = min(options.active_centres, old)
    best = teacher_logits.masked_fill(masked, -torch.inf).topk(count, dim=1)
    dead = torch.isneginf(best.values)

    prior = _prior(student.logits, best, old, options.temperature)
    if shared:
        metric = (student.offsets - teacher.offsets.detach()).abs()
    else:
        index = best.indices[:, :, None].expand(-1, -1, 3)
        gap = student.offsets.gather(1, index) - teacher.offsets.detach().gather(1, index)
        metric = gap.masked_fill(dead[:, :, None], 0.0).abs()
    output = (student.points - teacher.points.detach()).abs()

    scale = 1.0 / max(rows, 1)
    prior, metric, output = prior.sum() * scale, metric.sum() * scale, output.sum() * scale
    total = (
        options.prior_weight * prior
        + options.metric_weight * metric
        + options.output_weight * output
    )
    return SpddTerms(prior=prior, metric=metric, output=output, total=total)


def _prior(
    student_logits: Tensor, best: torch.return_types.topk, old: int, temperature: float
) -> Tensor:
    """Return the ``(n, M_a)`` summands of ``tau^2 KL(p_T || p_S)``; 0 at masked centres."""
    dead = torch.isneginf(best.values)
    target = _log_softmax(best.values / temperature)
    logits = torch.cat([student_logits.gather(1, best.indices), student_logits[:, old:]], dim=1)
    # A centre that only one head masks must not take part in either softmax.
    excluded = torch.isneginf(logits)
    excluded[:, : dead.shape[1]] |= dead
    student = _log_softmax(logits.masked_fill(excluded, -torch.inf) / temperature)
    gap = target - student[:, : dead.shape[1]]
    return (temperature**2 * target.exp() * gap).masked_fill(dead, 0.0)


def _log_softmax(logits: Tensor) -> Tensor:
    """Compute a log-softmax over dim 1 that is finite for logits of -inf (probability 0)."""
    # With -inf, the KL and its gradient would contain 0 * inf.
    floor = torch.finfo(logits.dtype).min / 8
    return logits.masked_fill(torch.isneginf(logits), floor).log_softmax(dim=1)


def _check_shapes(student: HeadOutput, teacher: HeadOutput) -> bool:
    """Return whether offsets are shared; raise ValueError for inconsistent shapes."""
    rows, old = teacher.logits.shape
    total = student.logits.shape[1]
    if student.logits.shape[0] != rows:
        raise ValueError(f"student has {student.logits.shape[0]} rows, teacher {rows}; give equal")
    if total < old:
        raise ValueError(f"student has {total} centres, teacher {old}; centres are only added")
    shapes = tuple(student.offsets.shape), tuple(teacher.offsets.shape)
    per_centre = shapes == ((rows, total, 3), (rows, old, 3))
    if not per_centre and shapes != ((rows, 1, 3), (rows, 1, 3)):
        raise ValueError(
            f"offsets have shapes {shapes[0]} (student) and {shapes[1]} (teacher); give both "
            "(n, centres, 3) or both (n, 1, 3)"
        )
    if student.points.shape != (rows, 3) or teacher.points.shape != (rows, 3):
        raise ValueError(
            f"points have shapes {tuple(student.points.shape)} (student) and "
            f"{tuple(teacher.points.shape)} (teacher); give ({rows}, 3)"
        )
    return not per_centre
