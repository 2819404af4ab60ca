"""Mixed precision where the hardware has it, or as the environment sets it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from evercal.errors import InputError
from evercal.features.encoder import load_encoder
from evercal.features.precision import VARIABLE, autocast, fast_bfloat16, has_bfloat16
from evercal.features.vlad import vlad_for
from evercal.mapping.pose_check import MatchedPair, matched_pairs
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.recordings.frame import Recording


def test_autocast_uses_the_reported_precision(device: torch.device) -> None:
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


def test_missing_cuda_device_has_no_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    """torch warns if mixed precision is not available; warnings are errors."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    has_bfloat16.cache_clear()
    with autocast("cuda"):
        assert not fast_bfloat16(torch.device("cuda", 1))
    has_bfloat16.cache_clear()


@pytest.mark.parametrize(("precision", "bfloat16"), [("float32", False), ("bfloat16", True)])
def test_environment_sets_the_precision(
    precision: str, bfloat16: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, precision)
    assert fast_bfloat16() == bfloat16
    with autocast():
        assert (torch.nn.Linear(4, 3)(torch.ones(1, 4)).dtype == torch.bfloat16) == bfloat16
    for automatic in ("auto", ""):
        monkeypatch.setenv(VARIABLE, automatic)
        assert fast_bfloat16() == has_bfloat16("cpu")
    monkeypatch.setenv(VARIABLE, "half")
    with pytest.raises(InputError, match="'half' is not a precision; set it to auto"):
        fast_bfloat16()


def test_float32_gives_the_same_matches_whatever_the_hardware(
    arcs: tuple[Recording, Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = arcs[0].train[:6]

    def matches(precision: str) -> list[MatchedPair]:
        monkeypatch.setenv(VARIABLE, precision)
        recording = PreparedFrames(frames, load_encoder(), WorkingSize(120, 120))
        return matched_pairs(recording, vlad_for(recording.encoder))

    monkeypatch.setattr("evercal.mapping.pose_check.MIN_MATCHES", 5)
    monkeypatch.setattr("evercal.features.precision.has_bfloat16", lambda kind: False)
    without = matches("auto")
    monkeypatch.setattr("evercal.features.precision.has_bfloat16", lambda kind: True)
    explicit = matches("float32")
    assert len(without) == len(explicit) > 0
    for one, two in zip(without, explicit, strict=True):
        assert (one.first, one.second) == (two.first, two.second)
        np.testing.assert_array_equal(one.pixels, two.pixels)
    shared = [len(pair.pixels) for pair in matches("bfloat16")]
    assert sum(shared) == pytest.approx(sum(len(pair.pixels) for pair in without), rel=0.1)
