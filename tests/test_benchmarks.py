"""Results of different settings never share a folder."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import sequence
from evercal.errors import InputError


def test_results_of_other_settings_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence.Runner([], tmp_path / "results")
    sequence.Runner([], tmp_path / "results")  # the same again
    before = sequence.stage_options

    def shorter(seed: int):
        options = before(seed)
        return replace(options, fit=replace(options.fit, iterations=7))

    monkeypatch.setattr(sequence, "stage_options", shorter)
    with pytest.raises(InputError, match=r"other settings: fit .*'iterations': 1000.*: 7.*--out"):
        sequence.Runner([], tmp_path / "results")
    sequence.Runner([], tmp_path / "others")


def test_results_of_other_rules_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence.Runner([], tmp_path / "results")
    stronger = replace(sequence.RULES["evercal"], protection=9.0)
    monkeypatch.setitem(sequence.RULES, "evercal", stronger)
    with pytest.raises(InputError, match=r"other settings: rules .*9\.0"):
        sequence.Runner([], tmp_path / "results")
