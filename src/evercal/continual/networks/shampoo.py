"""One-sided Shampoo, the optimiser of the head's hidden matrices."""

from collections.abc import Iterable

import torch
from torch import Tensor

from evercal.typing import Record

MOMENTUM = 0.95
"""Decay of the running mean of gradients per step."""
DECAY = 0.9
"""Decay of the second moment per step."""
EVERY = 10
"""Steps between two roots of the second moment."""
FLOOR = 1e-4
"""Added to the eigenvalues of the second moment, as a share of their mean."""


class OneSidedShampoo(torch.optim.Optimizer):
    """Shampoo (Gupta et al., ICML 2018) with one side and the root -1/2, for square matrices.

    The step of a matrix is M C^(-1/2), where M is the gradient with Nesterov momentum and C the
    running mean of M' M, as in ASGO (An et al., 2025). Its Frobenius norm is that of an orthogonal
    matrix. If C were M' M, the step would be that of Muon (Jordan et al., 2024). Two products and
    a tenth of an eigendecomposition replace the nine products of Muon.

    The `params` of a group are square matrices of one size, all with gradients. A step changes
    singular values by about the rate; the decoupled weight decay is relative to it.
    """

    def __init__(self, groups: Iterable[Record], rate: float, weight_decay: float):
        super().__init__(map(dict, groups), {"lr": rate, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Update all matrices."""
        for group in self.param_groups:
            matrices = group["params"]
            gradients = torch.stack([matrix.grad for matrix in matrices])
            # One product for all matrices of a group: their state is that of the first.
            changes = self._changes(self.state[matrices[0]], gradients)
            rate = group["lr"]
            decay = rate * group["weight_decay"]
            for matrix, change in zip(matrices, changes, strict=True):
                matrix.mul_(1 - decay)
                matrix.add_(change, alpha=-rate)

    def _changes(self, state: dict[str, Tensor], gradients: Tensor) -> Tensor:
        if not state:
            state["momentum"] = torch.zeros_like(gradients)
            # On the CPU, so that no step waits for a GPU.
            state["step"] = torch.zeros((), device="cpu")
        momentum = state["momentum"].lerp_(gradients, 1 - MOMENTUM)
        direction = gradients.lerp(momentum, MOMENTUM)
        squares = direction.mT @ direction
        moment = state.setdefault("moment", squares)
        if moment is not squares:
            moment.lerp_(squares, 1 - DECAY)
        if int(state["step"]) % EVERY == 0:
            state["root"] = inverse_root(moment)
        state["step"] += 1
        changes = direction @ state["root"]
        norm = torch.linalg.matrix_norm(changes, keepdim=True).clamp(min=1e-12)
        orthogonal = gradients.shape[-1] ** 0.5
        return changes * (orthogonal / norm)


def inverse_root(moments: Tensor) -> Tensor:
    """Return (C / c + floor)^(-1/2) of positive semi-definite matrices C (n, w, w).

    c is the mean eigenvalue; steps do not depend on it.
    """
    mean = moments.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    unit = torch.eye(moments.shape[-1], device=moments.device)
    scaled = moments / mean.clamp(min=1e-30) + FLOOR * unit
    try:
        values, vectors = torch.linalg.eigh(scaled)
    except RuntimeError:  # LinAlgError, which torch does not export
        # LAPACK's divide and conquer sometimes does not converge in single precision.
        values, vectors = torch.linalg.eigh(scaled.double())
    roots = values.float().clamp(min=FLOOR).rsqrt()
    vectors = vectors.float()
    return (vectors * roots[..., None, :]) @ vectors.mT
