"""Mixed precision is used where it is said to be, and can be used at all."""

import torch

from evercal.features.precision import autocast, fast_bfloat16


def test_autocast_runs_and_says_what_it_does() -> None:
    layer, rows = torch.nn.Linear(4, 3), torch.randn(5, 4)
    with autocast():
        inside = layer(rows)
    assert inside.dtype == (torch.bfloat16 if fast_bfloat16() else torch.float32)
    torch.testing.assert_close(inside.float(), layer(rows), atol=0.05, rtol=0.05)
    assert layer(rows).dtype == torch.float32


def test_gradients_under_autocast_are_single_precision() -> None:
    layer = torch.nn.Linear(4, 3)
    with autocast():
        cost = layer(torch.randn(5, 4)).float().square().sum()
    cost.backward()
    assert layer.weight.grad is not None
    assert layer.weight.grad.dtype == torch.float32
