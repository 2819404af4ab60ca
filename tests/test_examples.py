"""What a newcomer copies runs as it stands."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def python(words: list[str], folder: Path) -> str:
    """What a Python process says that has the package and a folder of its own."""
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


def test_the_python_of_the_readme_runs(tmp_path: Path) -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S)
    lines = python(["-c", block], tmp_path).splitlines()
    assert lines[0] == "bedroom"
    assert (tmp_path / "robot.evercal" / "manifest.json").is_file()
    assert float(lines[-1]) > 80


@pytest.mark.slow
def test_the_first_example_finds_the_camera(tmp_path: Path) -> None:
    said = python([str(ROOT / "examples" / "01_learn_and_localize.py")], tmp_path)
    millimetres = re.search(r"error: ([\d.]+) mm", said)
    assert "the image shows bedroom" in said
    assert "standard deviation" in said
    assert millimetres is not None
    assert float(millimetres[1]) < 5
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_second_example_calibrates_and_notices_the_bump(tmp_path: Path) -> None:
    said = python([str(ROOT / "examples" / "02_calibrate.py"), str(tmp_path)], tmp_path)
    assert "pose of camera in base" in said
    shift = re.search(r"moved: True, ([\d.]+) mm", said)
    assert shift is not None
    assert 4 < float(shift[1]) < 6  # the simulator moved it by 5 mm
    assert (tmp_path / "tripod.calib").read_text().count(":") > 10
