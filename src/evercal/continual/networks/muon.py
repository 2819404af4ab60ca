"""Muon, the optimiser of the head's hidden matrices (Jordan et al., 2024)."""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from evercal.features.precision import fast_bfloat16

MUON_STEPS = 3
"""Newton-Schulz iterations. Here three train as well as the usual five."""
_COEFFICIENTS = (3.4445, -4.775, 2.0315)
_MOMENTUM = 0.95


class Muon(torch.optim.Optimizer):
    """`torch.optim.Muon` for square matrices of one size, in the fastest precision of the device.

    `torch.optim.Muon` always multiplies in bfloat16. That is fifty times slower than float32 on
    processors without bfloat16 products.
    """

    def __init__(self, groups: Iterable[Mapping[str, object]], rate: float, weight_decay: float):
        super().__init__(map(dict, groups), {"lr": rate, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Update every matrix that has a gradient."""
        for group in self.param_groups:
            matrices = [matrix for matrix in group["params"] if matrix.grad is not None]
            if not matrices:
                continue
            changes = orthogonalised(torch.stack([self._direction(m) for m in matrices]))
            for matrix, change in zip(matrices, changes, strict=True):
                matrix.mul_(1 - group["lr"] * group["weight_decay"])
                matrix.add_(change, alpha=-group["lr"])

    def _direction(self, matrix: Tensor) -> Tensor:
        """Return the gradient with Nesterov momentum."""
        state, gradient = self.state[matrix], matrix.grad
        assert gradient is not None
        if not state:
            state["momentum_buffer"] = torch.zeros_like(gradient)
        state["momentum_buffer"].lerp_(gradient, 1 - _MOMENTUM)
        return gradient.lerp(state["momentum_buffer"], _MOMENTUM)


def orthogonalised(matrices: Tensor) -> Tensor:
    """Replace the singular values of (n, w, w) matrices by values near one."""
    a, b, c = _COEFFICIENTS
    x = matrices.bfloat16() if fast_bfloat16(matrices.device) else matrices
    x = x / torch.linalg.matrix_norm(x, keepdim=True).clamp(min=1e-7)
    for _ in range(MUON_STEPS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x
