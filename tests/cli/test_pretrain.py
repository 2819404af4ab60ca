"""`evercal pretrain` and its options."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from evercal.continual.pretraining import make
from evercal.continual.pretraining.contrastive import PretrainOptions


def test_options_reach_the_training(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[Path, Path, PretrainOptions]] = []
    monkeypatch.setattr(make, "pretrain", lambda *given: calls.append(given))
    ran = run("pretrain", "--out", tmp_path, "--steps", 7, "--seed", 3)
    assert ran.code == 0
    assert ran.out.splitlines()[-1].startswith("next: evercal learn ")
    run("pretrain", "--out", tmp_path, "--work", tmp_path / "w", "--json")
    options = dataclasses.replace(PretrainOptions(), steps=7, seed=3)
    assert calls == [
        (tmp_path, tmp_path / "work", options),
        (tmp_path, tmp_path / "w", PretrainOptions()),
    ]


def test_every_option_is_documented(run: Any) -> None:
    text = run("pretrain", "--help").out
    for field in dataclasses.fields(PretrainOptions):
        assert f"--{field.name.replace('_', '-')} " in text
    assert "Optimiser steps of the local encoder." in text


def test_bad_values_are_refused(run: Any, tmp_path: Path) -> None:
    assert run("pretrain").code == 2
    ran = run("pretrain", "--out", tmp_path, "--steps", "many", "--json")
    assert ran.code == 2
    assert "--steps" in json.loads(ran.out)["error"]
