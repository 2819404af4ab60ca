"""`evercal simulate`: bad input, and a tiny suite from end to end."""

import json
from pathlib import Path
from typing import Any

import pytest

from evercal.recordings import load_recording
from evercal.simulation import cell
from evercal.simulation.cell import Suite


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("lab", "--out", "x"), "lab"),
        (("sim",), "--out"),
        (("sim", "--out", "x", "--size", "640"), "640x480"),
        (("sim", "--out", "x", "--size", "4x4"), "at least 16x16"),
        (("sim", "--out", "x", "--frames", "1"), "at least 2"),
        (("sim", "--out", "x", "--seed", "9000"), "reserved"),
        (("sim", "--out", "x", "--frames", "1000000000"), "GB are free"),
        (("cell", "--out", "x", "--samples", "4"), "--samples"),
        (("cell", "--out", "x", "--seed", "9000"), "reserved"),
        (("cell", "--out", "x", "--size", "20x20"), "at least 64x64"),
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


def test_a_finished_suite_is_not_rendered_again(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mitsuba", reason="the extra 'sim' is not installed")
    suite = Suite((("den", "living", 103),), 3, (32, 24), 1)
    monkeypatch.setitem(cell.SUITES, "sim-mini", suite)
    monkeypatch.setattr(cell, "CALIBRATION_FRAMES", 1)
    out = tmp_path / "rooms"
    first = run("simulate", "sim-mini", "--out", out, "--json")
    assert first.code == 0, first.err
    report = json.loads(first.out)
    assert (report["scenes"], report["frames"]) == ([str(out / "den")], 6)
    scene = load_recording(out / "den")
    assert (len(scene.train), len(scene.test)) == (2, 1)
    assert scene.train[0].read_image().shape == (24, 32, 3)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.jpg")}
    again = run("simulate", "sim-mini", "--out", out, "--size", "32x24")
    assert again.code == 0
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.jpg")} == before
    other = run("simulate", "sim-mini", "--out", out, "--seed", "1")
    assert other.code == 2
    assert "seed 0, now it is 1" in other.err[-1]
