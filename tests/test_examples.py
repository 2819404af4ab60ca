"""The README's code and commands and the examples run as printed."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.calibration import read_transform
from evercal.cli import main
from evercal.geometry import SE3, pose_distance_mm_deg

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def run(words: list[str], folder: Path) -> str:
    """Run a Python process in a folder and return what it prints."""
    path = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_python_of_the_readme_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", README, re.M | re.S)
    monkeypatch.chdir(tmp_path)
    exec(block, {})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "bedroom"
    assert (tmp_path / "cell.evercal" / "manifest.json").is_file()
    assert (tmp_path / "tripod.calib").read_text().count(":") > 10
    assert any(re.match(r"True [45]\.\d+", line) for line in lines)  # bumped by 5 mm
    assert float(lines[-1]) > 80


def test_commands_of_the_readme_calibrate_the_packaged_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = README.split("## Command line")[1].split("##")[0]
    commands = [line.strip() for line in section.splitlines() if line.startswith("    evercal ")]
    assert len(commands) == 7
    monkeypatch.chdir(tmp_path)
    for command in commands:
        words = shlex.split(command, comments=True)[1:]
        assert main(words) == (1 if words[0] == "check" else 0), command  # 1: moved
    assert (tmp_path / "report.html").is_file()
    assert (tmp_path / "located.mp4").is_file()
    assert main(["check", "cell.evercal", "samples/cell/tripod", "--reference", "tripod.json"]) == 0
    truth = json.loads((tmp_path / "samples/cell/truth.json").read_text())
    for file, name in (("wrist.json", "gripper_from_camera"), ("tripod.json", "base_from_camera")):
        true = SE3(*(np.array(truth[name][key]) for key in ("quaternion_wxyz", "translation_m")))
        millimetres, degrees = pose_distance_mm_deg(read_transform(tmp_path / file), true)
        assert millimetres < 2
        assert degrees < 0.1
    images = json.loads((tmp_path / "tripod.json").read_text())["images"]
    assert sum(use["used"] for use in images) == 12


@pytest.mark.slow("examples")
def test_first_example_locates_the_camera(tmp_path: Path) -> None:
    output = run([str(ROOT / "examples" / "01_learn_and_localize.py")], tmp_path)
    millimetres = re.search(r"error: ([\d.]+) mm", output)
    assert "scene: bedroom" in output
    assert millimetres is not None
    assert float(millimetres[1]) < 5
    assert not list(tmp_path.iterdir())


@pytest.mark.slow("examples")
def test_second_example_calibrates_and_detects_the_bump(tmp_path: Path) -> None:
    output = run([str(ROOT / "examples" / "02_calibrate.py"), str(tmp_path)], tmp_path)
    assert "pose of camera in base" in output
    shift = re.search(r"moved: True, ([\d.]+) mm", output)
    assert shift is not None
    assert 4 < float(shift[1]) < 6
    assert (tmp_path / "tripod.calib").is_file()
