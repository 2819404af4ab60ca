"""`evercal simulate`: bad input, and a small cell from end to end."""

import json
from pathlib import Path
from typing import Any

import pytest

from evercal.recordings import load_recording


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("lab", "--out", "x"), "lab"),
        (("cell",), "--out"),
        (("cell", "--out", "x", "--size", "640"), "640x480"),
        (("cell", "--out", "x", "--size", "20x20"), "at least 64x64"),
        (("cell", "--out", "x", "--frames", "0"), "at least 1"),
        (("cell", "--out", "x", "--seed", "9000"), "reserved"),
    ],
)
def test_bad_input_is_refused_and_nothing_is_written(
    words: tuple[str, ...],
    message: str,
    run: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = run("simulate", *words)
    assert (ran.code, ran.out) == (2, "")
    assert any(message in line for line in ran.err)
    assert not list(tmp_path.iterdir())


def test_a_cell_has_the_stated_parts(run: Any, tmp_path: Path) -> None:
    out = tmp_path / "cell"
    words = ("--frames", "3", "--size", "64x64", "--seed", "4", "--noise", "0", "--json")
    ran = run("simulate", "cell", "--out", out, *words)
    assert ran.code == 0, ran.err
    report = json.loads(ran.out)
    assert (report["scenes"], report["frames"]) == ([str(out / "wrist")], 3 + 8)
    frames = load_recording(out / "wrist").train
    assert [frame.read_image().shape for frame in frames] == 3 * [(64, 64, 3)]
    assert len(list(Path(report["tripod"]).iterdir())) == 8
    truth = json.loads(Path(report["truth.json"]).read_text())
    assert (truth["seed"], truth["options"]["image_noise"]) == (4, 0)
