"""`evercal report --again`: a calibration made again from its record."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.hand_eye import Setting, recording
from evercal.calibration.calibration import read_calibration

from .test_solve import files


@pytest.fixture
def solved(run, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    simulated = recording(Setting(noise_mm=0.5, noise_deg=0.05), 0)
    assert run(*files(Path(), simulated), "--mount eye_in_hand").code == 0
    return tmp_path / "out.json"


def test_a_calibration_says_what_made_it(run, solved) -> None:
    made = read_calibration(solved).made
    assert made is not None
    assert made.command[:2] == ("evercal", "solve")
    assert set(made.inputs) == {"robot.csv", "camera.csv"}
    assert run("report", solved).code == 0
    page = Path("report.html").read_text()
    assert made.inputs["robot.csv"] in page
    assert f"evercal {made.version}, {made.date}: evercal solve" in page


def test_the_same_inputs_give_the_same_answer(run, solved) -> None:
    before = solved.read_bytes()
    again = run.json("report", "out.json", "--again")["again"]
    assert again.startswith("made again: the version and the inputs are the same")
    assert again.endswith("it differs by 0.000 mm and 0.0000 deg, 0.0 sigma")
    assert solved.read_bytes() == before
    assert again in Path("report.html").read_text()


def test_what_differs_is_named(run, solved) -> None:
    rows = Path("robot.csv").read_text().splitlines()
    Path("robot.csv").write_text("\n".join([*rows[:-1], rows[-2]]))
    again = run.json("report", "out.json", "--again")["again"]
    assert "robot.csv was files: 1, sha256: " in again
    assert not again.endswith(" 0.0000 deg, 0.0 sigma")
    Path("robot.csv").unlink()
    line = run.refused("report", "out.json", "--again")
    assert line.startswith("error: out.json: robot.csv was ")
    assert line.endswith("is gone; run this in the folder where it was made")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"made": None}, "records nothing, as files before evercal 0.3"),
        ({"made": {"command": ["evercal", "map", "remove", "m", "s"]}}, "map remove m"),
        ({"made": {"command": ["evercal.solve"]}}, "evercal.solve"),
    ],
)
def test_only_commands_that_calibrate_are_run_again(run, solved, change, words) -> None:
    record = json.loads(solved.read_bytes())
    for name, value in change.items():
        record[name] = value and {**record[name], **value}
    solved.write_text(json.dumps(record))
    line = run.refused("report", "out.json", "--again")
    assert words in line
    assert line.endswith("make it anew and give the old file with --against")
