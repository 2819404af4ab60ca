"""SPDD, structure-preserving dual distillation (Algorithm 2 of the paper).

SPDD is the complete replay loss of the paper; it contains no reprojection error. Every term is
summed over active centres and coordinates and averaged over rows.
"""

import torch
from torch import Tensor

from evercal.classes import frozen
from evercal.continual.networks.head import HeadOutput
from evercal.errors import require_numbers


@frozen
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
        require_numbers(self, ("prior_weight", "metric_weight", "output_weight"), 0)
        require_numbers(self, ("temperature",), 1e-9)
        require_numbers(self, ("active_centres",), 1)


def spdd_loss(student: HeadOutput, teacher: HeadOutput, options: SpddOptions) -> Tensor:
    """Compute the distillation loss of a student against a teacher on the same rows.

    The active set A of a row contains its M_a highest teacher logits. A centre that either head
    masks (logit -inf) is never active. The loss is the weighted sum of

    - prior: ``tau^2 KL(p_T || p_S)``. The teacher's softmax ``p_T`` is over A. The student's
      softmax ``p_S`` is over A and over the centres N that the teacher does not have. With s the
      student's probability of A within A and N, this equals the paper's term plus
      ``-tau^2 log s``, which lowers the logits of new centres on old rows. Without new centres it
      is the paper's term. Old centres outside A are free, as in the paper.
    - metric: ``|Delta_S - Delta_T|`` at A with per-centre offsets, or of the single shared offset.
    - output: ``|x_S - x_T|``.

    Centre k of the teacher is centre k of the student; new centres follow. A row without active
    centres has no prior term, and no metric term with per-centre offsets. NaN propagates. The
    teacher is detached.
    """
    shared = student.offsets.shape[1] < student.logits.shape[1]
    rows, old = teacher.logits.shape
    teacher_logits = teacher.logits.detach()
    student_logits = student.logits.detach()[:, :old]
    masked = torch.isneginf(teacher_logits) | torch.isneginf(student_logits)
    count = min(options.active_centres, old)
    best = teacher_logits.masked_fill(masked, -torch.inf).topk(count, dim=1)
    dead = torch.isneginf(best.values)

    prior = _prior(student.logits, best, old, options.temperature)
    if shared:
        metric = (student.offsets - teacher.offsets.detach()).abs()
    else:
        index = best.indices[:, :, None].expand(-1, -1, 3)
        teacher_offsets = teacher.offsets.detach().gather(1, index)
        gap = student.offsets.gather(1, index) - teacher_offsets
        metric = gap.masked_fill(dead[:, :, None], 0.0).abs()
    output = (student.points - teacher.points.detach()).abs()

    total = (
        options.prior_weight * prior.sum()
        + options.metric_weight * metric.sum()
        + options.output_weight * output.sum()
    )
    return total / max(rows, 1)


def _prior(
    student_logits: Tensor, best: torch.return_types.topk, old: int, temperature: float
) -> Tensor:
    dead = torch.isneginf(best.values)
    target = _log_softmax(best.values / temperature)
    active = student_logits.gather(1, best.indices)
    # A centre that only one head masks must not take part in either softmax.
    active = active.masked_fill(dead, -torch.inf)
    logits = torch.cat([active, student_logits[:, old:]], dim=1)
    student = _log_softmax(logits / temperature)
    gap = target - student[:, : dead.shape[1]]
    return (temperature**2 * target.exp() * gap).masked_fill(dead, 0.0)


def _log_softmax(logits: Tensor) -> Tensor:
    # Finite for a logit of -inf, where the KL and its gradient would contain 0 * inf.
    floor = torch.finfo(logits.dtype).min / 8
    return logits.masked_fill(torch.isneginf(logits), floor).log_softmax(dim=1)
