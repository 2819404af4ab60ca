"""Muon against torch.optim.Muon, which multiplies in bfloat16."""

import pytest
import torch

from evercal.continual.networks import muon
from evercal.continual.networks.muon import MUON_STEPS, Muon


@pytest.mark.parametrize(("fast", "tolerance"), [(True, 2e-2), (False, 3e-2)])
def test_updates_match_torch(fast: bool, tolerance: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(muon, "fast_bfloat16", lambda device: fast)
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(24, 24, generator=generator) for _ in range(3)]
    ours, theirs = ([torch.nn.Parameter(m.clone()) for m in start] for _ in range(2))
    unused = torch.nn.Parameter(start[0].clone())
    one = Muon([{"params": [*ours, unused]}], 0.05, 0.1)
    other = torch.optim.Muon(theirs, lr=0.05, weight_decay=0.1, ns_steps=MUON_STEPS)
    for _ in range(5):
        for mine, yours in zip(ours, theirs, strict=True):
            mine.grad = torch.randn(24, 24, generator=generator)
            yours.grad = mine.grad.clone()
        one.step()
        other.step()
    for mine, yours, before in zip(ours, theirs, start, strict=True):
        moved = (yours - before).norm()
        assert (mine - yours).norm() < tolerance * moved
    assert torch.equal(unused, start[0])
    # Checkpoints are interchangeable.
    assert one.state[ours[0]].keys() == other.state[theirs[0]].keys()
