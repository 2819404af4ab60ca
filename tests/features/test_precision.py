"""Mixed precision is used where it is said to be, and can be used at all."""

import pytest
import torch

from evercal.features.precision import _fast_bfloat16, autocast, fast_bfloat16


def test_autocast_runs_and_says_what_it_does(device: torch.device) -> None:
    layer, rows = torch.nn.Linear(4, 3).to(device), torch.randn(5, 4).to(device)
    with autocast(device):
        inside = layer(rows)
    assert inside.dtype == (torch.bfloat16 if fast_bfloat16(device) else torch.float32)
    torch.testing.assert_close(inside.float(), layer(rows), atol=0.05, rtol=0.05)
    assert layer(rows).dtype == torch.float32


def test_gradients_under_autocast_are_single_precision(device: torch.device) -> None:
    layer = torch.nn.Linear(4, 3).to(device)
    with autocast(device):
        cost = layer(torch.randn(5, 4).to(device)).float().square().sum()
    cost.backward()
    assert layer.weight.grad is not None
    assert layer.weight.grad.dtype == torch.float32


def test_autocast_for_cuda_says_nothing_where_there_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """torch warns when mixed precision is asked for that a machine lacks; warnings are errors."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    _fast_bfloat16.cache_clear()
    with autocast("cuda"):
        assert not fast_bfloat16(torch.device("cuda", 1))
    _fast_bfloat16.cache_clear()
