"""How the gradient of new rows joins those of remembered scenes, where they are not just added.

A rule takes flat gradients and gives the one that the optimiser sees. Their sum (plain replay) is
no rule here: it is what one backward pass gives.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from evercal.networks.gradients import Gradients


def averaged_constraint(g: Gradients) -> Tensor:
    """A-GEM (Chaudhry et al., ICLR 2019): new rows alone, but not against the mean of the memory.

    Where both disagree, the part of the new gradient against the memory's is taken out. Remembered
    rows are never trained on.
    """
    mean = g.memory.mean(0)
    against = g.new @ mean
    if against >= 0:
        return g.new
    return g.new - against / (mean @ mean).clamp(min=1e-12) * mean


def gem(g: Gradients, margin: float = 0.5) -> Tensor:
    """GEM (Lopez-Paz and Ranzato, NeurIPS 2017): no remembered scene's loss may rise.

    The nearest gradient v with <v, g_t> >= 0 for every t; `margin` is added to the dual variables
    as the original does, which favours the memory.
    """
    if not len(g.memory) or bool((g.memory @ g.new >= 0).all()):
        return g.new
    weights = _dual(g.memory, g.memory @ g.new, torch.zeros(len(g.memory)))
    return g.new + (weights + margin) @ g.memory


GEC_ALPHA = 0.5
GEC_SLACK = 0.05
GEC_WARM_STEPS = 5


def episodic_barrier(g: Gradients) -> Tensor:
    """GEC (Lai et al., NeurIPS 2025), several constraints, references as in its appendix.

    With h_t = loss_t - 1.05 reference_t, the nearest gradient v to the new one with
    <v, g_t> >= alpha h_t: a remembered scene whose loss has risen by over 5 % since it was learned
    must get better, others may get worse by so much. The first 5 steps are plain replay. The
    original's look-ahead step before each g_t is left out: with one network trained at a rate that
    changes all the time it has no natural size.
    """
    if g.step < GEC_WARM_STEPS:
        return g.new + g.memory.mean(0)
    bound = GEC_ALPHA * (g.losses - (1 + GEC_SLACK) * g.references.nan_to_num(torch.inf))
    active = torch.isfinite(bound)
    if not bool(active.any()):
        return g.new
    memory, bound = g.memory[active], bound[active]
    return g.new + _dual(memory, memory @ g.new, bound) @ memory


def moving_barrier(g: Gradients) -> Tensor:
    """The same with the references of the original's Algorithm 1: the losses of the step before.

    Then no step may raise a remembered loss by over 5 %, and nothing stops many small ones.
    """
    return episodic_barrier(replace(g, references=g.before))


def _dual(memory: Tensor, along: Tensor, bound: Tensor) -> Tensor:
    """(t,) lambda >= 0 of min |v - g|^2 with M v >= bound; v = g + lambda M, along = M g.

    The dual min 1/2 l'Gl - l'(bound - along) with G = M M' is a least-squares problem in G's root.
    """
    from scipy.optimize import nnls

    gram = (memory @ memory.T).double().numpy()
    values, vectors = np.linalg.eigh(gram)
    # Parallel constraints make G singular; this little keeps their answer finite.
    root = np.sqrt(np.maximum(values, 0) + 1e-9 * max(values.max(), 1e-12))
    wanted = (vectors / root).T @ (bound - along).double().numpy()
    weights, _ = nnls((vectors * root).T, wanted)
    return torch.from_numpy(weights).to(memory)
