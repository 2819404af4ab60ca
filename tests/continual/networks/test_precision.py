"""Mixed precision where the hardware has it, or as the environment sets it."""

from __future__ import annotations

import pytest
import torch

from evercal.continual.networks.precision import (
    VARIABLE,
    autocast,
    fast_bfloat16,
    has_bfloat16,
)
from evercal.errors import InputError


def test_autocast_uses_the_reported_precision(device: torch.device) -> None:
    layer = torch.nn.Linear(4, 3).to(device)
    rows = torch.randn(5, 4).to(device)
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


def test_missing_cuda_device_has_no_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    """torch warns if mixed precision is not available; warnings are errors."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    has_bfloat16.cache_clear()
    with autocast("cuda"):
        assert not fast_bfloat16(torch.device("cuda", 1))
    has_bfloat16.cache_clear()


@pytest.mark.parametrize(
    ("precision", "bfloat16"), [("float32", False), ("bfloat16", True)]
)
def test_environment_sets_the_precision(
    precision: str, bfloat16: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, precision)
    assert fast_bfloat16() == bfloat16
    with autocast():
        assert (
            torch.nn.Linear(4, 3)(torch.ones(1, 4)).dtype == torch.bfloat16
        ) == bfloat16
    for automatic in ("auto", ""):
        monkeypatch.setenv(VARIABLE, automatic)
        assert fast_bfloat16() == has_bfloat16("cpu")
    monkeypatch.setenv(VARIABLE, "half")
    with pytest.raises(InputError, match="'half' is not a precision; set it to auto"):
        fast_bfloat16()
