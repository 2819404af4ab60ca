"""SPDD: what a frozen teacher asks of a student on replayed rows (Algorithm 2 of the paper).

No reprojection error is computed on replayed rows here: SPDD is the whole replay loss of the
paper. Every term is summed over active centres and xyz and averaged over rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class CentreOutput(Protocol):
    """What SPDD reads from a head's output for n rows and K cluster centres."""

    @property
    def logits(self) -> Tensor:
        """``(n, K)`` scores of the centres; -inf marks a masked centre."""
        ...

    @property
    def offsets(self) -> Tensor:
        """``(n, K, 3)`` per centre or ``(n, 1, 3)`` shared, metres, already divided by scale."""
        ...

    @property
    def points(self) -> Tensor:
        """``(n, 3)`` scene coordinates, metres."""
        ...


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
    """Largest number M_a of active centres per row; all that are alive in it where it has fewer."""

    def __post_init__(self) -> None:
        """Refuse settings that make no loss."""
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
    """The parts of the loss, each a scalar; `total` is weighted, the others are not."""

    prior: Tensor
    metric: Tensor
    output: Tensor
    total: Tensor


def spdd_loss(student: CentreOutput, teacher: CentreOutput, options: SpddOptions) -> SpddTerms:
    """Return the distillation loss of `student` against `teacher` on the same rows.

    The active set A of a row holds the teacher's M_a highest logits among the centres that are
    alive in it, or all of those where there are fewer. The terms are

    - prior: ``tau^2 KL(p_T || p_S)``. Teacher: ``p_T = softmax(z_T / tau)`` over A. Student:
      softmax over A and, if it has more centres than the teacher, over its new centres N too::

          p_S,i = exp(z_S,i / tau) / sum over j in A and N of exp(z_S,j / tau)

      which equals the paper's term plus ``tau^2 * -log(share of A in A and N)``. Both parts are
      >= 0: probability that the student moves from A to new centres costs, and pulls their
      logits down on old rows. Without new centres it is exactly the paper's term. Normalising
      over *all* of the student's centres is not done: it would charge ``-log p_S(A)`` to a
      student that equals its teacher and sharpen what the teacher left broad. So, as in the
      paper, old centres outside A are free here; only the output term sees them.
    - metric: ``|Delta_S - Delta_T|`` at A, per_centre offsets; of the one offset if shared.
    - output: ``|x_S - x_T|``.

    New centres are appended: centre k of the teacher is centre k of the student. A centre that
    either of them masks (logit -inf) is never active; a row in which none is left adds nothing to
    the prior term nor, for per_centre offsets, to the metric term. NaN in an input stays NaN.

    Args:
        student: output with gradients, K_student >= K_teacher centres.
        teacher: output for the same rows; detached here.
        options: weights, temperature and size of the active set.

    Returns:
        The three terms (nats, metres, metres) and their weighted sum; 0 for no rows.

    Raises:
        ValueError: shapes that do not belong together.
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
    """Return ``(n, M_a)`` summands of ``tau^2 KL(p_T || p_S)``; 0 at masked centres."""
    dead = torch.isneginf(best.values)
    target = _log_softmax(best.values / temperature)
    wanted = torch.cat([student_logits.gather(1, best.indices), student_logits[:, old:]], dim=1)
    # A dead centre may be alive in one of the two: it must not take part in either softmax.
    beyond = torch.isneginf(wanted)
    beyond[:, : dead.shape[1]] |= dead
    found = _log_softmax(wanted.masked_fill(beyond, -torch.inf) / temperature)
    gain = target - found[:, : dead.shape[1]]
    return (temperature**2 * target.exp() * gain).masked_fill(dead, 0.0)


def _log_softmax(logits: Tensor) -> Tensor:
    """Log-softmax over dim 1 that stays finite where logits are -inf (probability still 0)."""
    # -inf would give 0 * inf in the KL and NaN in its gradient; exp of this is 0 just as well.
    floor = torch.finfo(logits.dtype).min / 8
    return logits.masked_fill(torch.isneginf(logits), floor).log_softmax(dim=1)


def _check_shapes(student: CentreOutput, teacher: CentreOutput) -> bool:
    """Return whether offsets are shared; raise ValueError if the outputs do not fit."""
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
