"""`python -m training` and its options."""

import dataclasses
from pathlib import Path

import pytest

import training.__main__ as command
from training.contrastive import PretrainOptions

pytestmark = pytest.mark.slow("training", "src/evercal/features")


def test_options_reach_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[Path, Path, PretrainOptions]] = []
    monkeypatch.setattr(command, "pretrain", lambda *given: calls.append(given))
    assert command.main(["--out", str(tmp_path), "--steps", "7", "--seed", "3"]) == 0
    assert command.main(["--out", str(tmp_path), "--work", str(tmp_path / "w")]) == 0
    options = dataclasses.replace(PretrainOptions(), steps=7, seed=3)
    assert calls == [
        (tmp_path, tmp_path / "work", options),
        (tmp_path, tmp_path / "w", PretrainOptions()),
    ]


def test_an_output_that_is_a_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("x")
    assert command.main(["--out", str(tmp_path / "file" / "x")]) == 2
    assert "file" in capsys.readouterr().err
