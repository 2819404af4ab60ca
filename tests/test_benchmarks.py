"""The gate lets through what is as good as the baseline, and nothing else."""

import json

import pytest

from benchmarks import gate


def test_the_gate_knows_directions_and_tolerances() -> None:
    points = gate.Metric("%", "higher", 5.0)
    assert points.holds(80.0, 75.0)
    assert not points.holds(80.0, 74.9)
    ratio = gate.Metric("kernels", "lower", 0.5)
    assert ratio.holds(4.0, 6.0)
    assert not ratio.holds(4.0, 6.1)


def test_the_gate_names_what_is_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    now = dict.fromkeys(gate.CONTRACT, 50.0)
    rows, broken = gate.judge(now, now)
    assert broken == []
    assert {row[-1] for row in rows} == {"yes"}
    worse = {**now, "accuracy, 1 cm 1 deg": 20.0, "learning a map": 200.0}
    assert gate.judge(now, worse)[1] == ["accuracy, 1 cm 1 deg", "learning a map"]
    # What has no baseline is not waved through.
    known = {name: value for name, value in now.items() if name != "head"}
    assert gate.judge(known, now)[1] == ["head"]


def test_the_baseline_covers_the_contract() -> None:
    baseline = json.loads(gate.BASELINE.read_text())
    assert baseline.keys() == gate.CONTRACT.keys()
