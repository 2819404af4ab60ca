"""Muon, the optimiser of the head's hidden matrices (K. Jordan et al., Muon, 2024)."""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from evercal.features.precision import fast_bfloat16

MUON_STEPS = 3
"""Newton-Schulz iterations. Three train as well as the usual five here, and cost less."""
_COEFFICIENTS = (3.4445, -4.775, 2.0315)
_MOMENTUM = 0.95


class Muon(torch.optim.Optimizer):
    """What `torch.optim.Muon` does, for square matrices of one size.

    That one multiplies in bfloat16 on every device, which processors without bfloat16 products do
    fifty times slower than in float32. This one takes what the device is fast at.
    """

    def __init__(self, groups: Iterable[Mapping[str, object]], rate: float, weight_decay: float):
        super().__init__(map(dict, groups), {"lr": rate, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Moves every matrix that has a gradient."""
        for group in self.param_groups:
            matrices = [matrix for matrix in group["params"] if matrix.grad is not None]
            if not matrices:
                continue
            changes = orthogonalised(torch.stack([self._direction(m) for m in matrices]))
            for matrix, change in zip(matrices, changes, strict=True):
                matrix.mul_(1 - group["lr"] * group["weight_decay"])
                matrix.add_(change, alpha=-group["lr"])

    def _direction(self, matrix: Tensor) -> Tensor:
        """The gradient with Nesterov's momentum."""
        state, gradient = self.state[matrix], matrix.grad
        assert gradient is not None
        if not state:
            state["momentum_buffer"] = torch.zeros_like(gradient)
        state["momentum_buffer"].lerp_(gradient, 1 - _MOMENTUM)
        return gradient.lerp(state["momentum_buffer"], _MOMENTUM)


def orthogonalised(matrices: Tensor) -> Tensor:
    """(n, w, w) with singular values near one and the singular vectors of (n, w, w) matrices."""
    a, b, c = _COEFFICIENTS
    found = matrices.bfloat16() if fast_bfloat16(matrices.device) else matrices
    found = found / torch.linalg.matrix_norm(found, keepdim=True).clamp(min=1e-7)
    for _ in range(MUON_STEPS):
        gram = found @ found.mT
        found = torch.baddbmm(
            found, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), found, beta=a
        )
    return found
