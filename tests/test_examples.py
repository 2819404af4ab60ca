"""The README's code and commands and the examples run as printed."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def run(words: list[str], folder: Path, code: int = 0) -> str:
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
    assert done.returncode == code, done.stderr
    return done.stdout


def test_python_of_the_readme_runs(tmp_path: Path) -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", README, re.M | re.S)
    lines = run(["-c", block], tmp_path).splitlines()
    assert lines[0] == "bedroom"
    assert (tmp_path / "cell.evercal" / "manifest.json").is_file()
    assert (tmp_path / "tripod.calib").read_text().count(":") > 10
    assert any(re.match(r"True [45]\.\d+", line) for line in lines)  # bumped by 5 mm
    assert float(lines[-1]) > 80


def test_commands_of_the_readme_run_on_the_packaged_cell(tmp_path: Path) -> None:
    section = README.split("## Command line")[1].split("##")[0]
    commands = [line.strip() for line in section.splitlines() if line.startswith("    evercal ")]
    assert len(commands) == 7
    for command in commands:
        words = shlex.split(command, comments=True)[1:]
        moved = words[0] == "check"
        run(["-m", "evercal", *words], tmp_path, code=1 if moved else 0)
    assert (tmp_path / "wrist.json").is_file()
    assert (tmp_path / "report.html").is_file()
    assert (tmp_path / "located.mp4").is_file()


def test_first_example_locates_the_camera(tmp_path: Path) -> None:
    output = run([str(ROOT / "examples" / "01_learn_and_localize.py")], tmp_path)
    millimetres = re.search(r"error: ([\d.]+) mm", output)
    assert "scene: bedroom" in output
    assert millimetres is not None
    assert float(millimetres[1]) < 5
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_second_example_calibrates_and_detects_the_bump(tmp_path: Path) -> None:
    output = run([str(ROOT / "examples" / "02_calibrate.py"), str(tmp_path)], tmp_path)
    assert "pose of camera in base" in output
    shift = re.search(r"moved: True, ([\d.]+) mm", output)
    assert shift is not None
    assert 4 < float(shift[1]) < 6
    assert (tmp_path / "tripod.calib").is_file()
