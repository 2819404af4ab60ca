"""Peak memory in the unit of the platform."""

from types import SimpleNamespace

import pytest
import torch

from benchmarks import peak_memory


@pytest.mark.parametrize(("platform", "unit"), [("linux", 1024), ("darwin", 1)])
def test_peak_memory_uses_the_unit_of_the_platform(
    platform: str, unit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = SimpleNamespace(ru_maxrss=2_000_000)
    monkeypatch.setattr(peak_memory.sys, "platform", platform)
    monkeypatch.setattr(peak_memory.resource, "getrusage", lambda _: usage)
    assert peak_memory.peak_gb(torch.device("cpu")) == pytest.approx(2e-3 * unit)
