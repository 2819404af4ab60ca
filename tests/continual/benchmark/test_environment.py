"""Records of where a result was measured."""

from pathlib import Path

import pytest
import torch

from evercal.continual.benchmark import environment as module, results
from evercal.continual.benchmark.environment import environment


def test_records_of_several_machines_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = environment()
    assert record["torch"] == torch.__version__
    assert int(record["threads"]) >= 1
    first = results.record_environment(tmp_path)
    assert results.record_environment(tmp_path) == first
    assert len(first) == 8
    other = {**record, "processor": "another"}
    monkeypatch.setattr(results, "environment", lambda: other)
    second = results.record_environment(tmp_path)
    assert results.read_records(tmp_path / results.ENVIRONMENTS) == {
        first: record,
        second: other,
    }


def test_without_a_checkout_the_version_is_recorded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing(*_: object, **__: object) -> None:
        raise FileNotFoundError("git")

    monkeypatch.setattr(module, "output_of", missing)
    assert module._commit().startswith("evercal ")
