"""One-sided Shampoo against its definition, and against Muon in its limit."""

import pytest
import torch

from evercal.continual.networks.shampoo import (
    DECAY,
    EVERY,
    FLOOR,
    MOMENTUM,
    OneSidedShampoo,
    inverse_root,
)

from ..draws import seeded


def _gradients(steps: int, width: int = 24) -> list[torch.Tensor]:
    generator = seeded(0)
    return [torch.randn(width, width, generator=generator) for _ in range(steps)]


def test_inverse_root_inverts_the_square() -> None:
    a = torch.randn(2, 60, 16, generator=seeded(1))
    moment = a.mT @ a
    root = inverse_root(moment)
    mean = moment.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    whole = root @ (moment / mean) @ root
    torch.testing.assert_close(
        whole, torch.eye(16).expand(2, -1, -1), atol=5e-3, rtol=0
    )
    torch.testing.assert_close(inverse_root(1e-20 * moment), root)


def test_double_precision_is_tried_if_single_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    a = torch.randn(2, 60, 16, generator=seeded(1))
    expected = inverse_root(a.mT @ a)
    eigh = torch.linalg.eigh

    def failing(matrices: torch.Tensor) -> object:
        if matrices.dtype == torch.float32:
            raise RuntimeError("linalg.eigh: failed to converge")
        return eigh(matrices)

    monkeypatch.setattr(torch.linalg, "eigh", failing)
    torch.testing.assert_close(inverse_root(a.mT @ a), expected, atol=1e-4, rtol=1e-4)


def test_rank_deficient_moments_stay_finite() -> None:
    column = torch.ones(1, 8, 1)
    assert bool(inverse_root(column @ column.mT).isfinite().all())
    assert bool(inverse_root(torch.zeros(1, 8, 8)).isfinite().all())


def test_steps_follow_the_definition() -> None:
    steps = 2 * EVERY + 3
    start = torch.eye(24)
    matrix = torch.nn.Parameter(start.clone())
    optimiser = OneSidedShampoo([{"params": [matrix]}], 0.05, 0.1)
    expected = start.double()
    momentum = torch.zeros(24, 24).double()
    moment = root = torch.zeros(24, 24).double()
    for number, gradient in enumerate(_gradients(steps)):
        matrix.grad = gradient
        optimiser.step()
        g = gradient.double()
        momentum = MOMENTUM * momentum + (1 - MOMENTUM) * g
        direction = (1 - MOMENTUM) * g + MOMENTUM * momentum
        new = direction.T @ direction
        moment = new if number == 0 else DECAY * moment + (1 - DECAY) * new
        if number % EVERY == 0:
            values, vectors = torch.linalg.eigh(moment)
            root = (
                vectors
                @ torch.diag((values / values.mean() + FLOOR) ** -0.5)
                @ vectors.T
            )
        change = direction @ root
        change *= 24**0.5 / change.norm()
        expected = expected * (1 - 0.05 * 0.1) - 0.05 * change
    assert (matrix - expected).norm() < 1e-3 * (expected - start).norm()


def test_matrices_are_independent() -> None:
    gradients = _gradients(2 * EVERY)
    matrices = [torch.nn.Parameter(torch.eye(24) * k) for k in (1.0, 2.0)]
    alone = torch.nn.Parameter(torch.eye(24))
    both = OneSidedShampoo([{"params": matrices}], 0.05, 0.1)
    one = OneSidedShampoo([{"params": [alone]}], 0.05, 0.1)
    for gradient in gradients:
        matrices[0].grad = gradient
        matrices[1].grad = -gradient
        alone.grad = gradient
        both.step()
        one.step()
    torch.testing.assert_close(matrices[0], alone, atol=1e-6, rtol=1e-5)
    assert not torch.allclose(matrices[1], alone, atol=0.1)
