"""The numbered examples run as a reader runs them, in one folder."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from evercal.calibration.transform_file import read_transform
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.recordings import load_recording

from . import arm_cell
from .live.ros2.graphs import environment

EXAMPLES = Path(__file__).parents[1] / "examples"
NUMBERED = sorted(EXAMPLES.glob("[0-9]*.py"))
slow = pytest.mark.slow("examples")


def example(name: str, folder: Path, *words: str) -> str:
    """Run an example in a folder; return what it prints."""
    path = os.pathsep.join([str(EXAMPLES.parent / "src"), *sys.path])
    done = subprocess.run(
        [sys.executable, EXAMPLES / name, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_all_are_numbered_short_and_have_a_test() -> None:
    assert [path.name[:2] for path in NUMBERED] == [f"{i:02}" for i in range(1, 12)]
    tests = Path(__file__).read_text("utf-8")
    tests += (Path(__file__).parent / "service" / "test_client.py").read_text("utf-8")
    for path in NUMBERED:
        assert len(path.read_text("utf-8").splitlines()) < 40
        assert f'"{path.name}"' in tests


@slow
def test_wrist(tmp_path: Path) -> None:
    assert "Good for precision assembly" in example("01_wrist.py", tmp_path)
    assert 'link="tool0"' in (tmp_path / "wrist.urdf").read_text()


def test_tripod(cell: Path, tmp_path: Path) -> None:
    shutil.copytree(cell / "cell.evercal", tmp_path / "cell.evercal")
    output = example("02_tripod.py", tmp_path)
    assert "pose of tripod_optical in base_link" in output
    shift = re.search(r"moved: True, ([\d.]+) mm", output)
    assert shift is not None
    assert 4 < float(shift[1]) < 6


def test_arm_in_view(tmp_path: Path) -> None:
    arm_cell.write(tmp_path / "tripod")
    output = example("11_arm_in_view.py", tmp_path, "tripod")
    assert "turn its offset turns the frame of the base" in output
    true = arm_cell.BASE_FROM_CAMERA
    assert pose_distance_mm_deg(read_transform(tmp_path / "tripod.json"), true)[0] < 2


@slow
def test_box(tmp_path: Path) -> None:
    example("03_box.py", tmp_path)
    truth = json.loads((tmp_path / "box/truth.json").read_text("utf-8"))
    pose = truth["base_from_tripod"]
    true = SE3(pose["quaternion_wxyz"], pose["translation_m"])
    assert pose_distance_mm_deg(read_transform(tmp_path / "tripod.json"), true)[0] < 1


def test_board(tmp_path: Path) -> None:
    output = example("04_board.py", tmp_path)
    found = read_transform(tmp_path / "tripod.json").translation_m
    assert abs(found - [1.0, 0.2, 0.5]).max() < 0.001
    assert "20 of 20 used" in output
    assert (tmp_path / "tripod.html").is_file()


@slow
def test_phone_map(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    output = example("05_phone_map.py", tmp_path)
    aligned = re.search(r"(\d+) of 12 images, sigma ([\d.]+) mm", output)
    assert aligned is not None
    assert int(aligned[1]) >= 8
    assert "Good for" in output


@slow
def test_several_scenes(tmp_path: Path) -> None:
    output = example("06_several_scenes.py", tmp_path)
    for room in ("bedroom", "kitchen", "living"):
        assert f"{room}: {room}, ok, ok" in output


def test_verify(cell: Path, tmp_path: Path) -> None:
    shutil.copytree(cell / "cell.evercal", tmp_path / "cell.evercal")
    right, pushed = example("07_verify.py", tmp_path).splitlines()
    assert right.endswith("honest")
    assert pushed.endswith("not as stated")


@pytest.fixture
def _in_own_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in environment().items():
        monkeypatch.setenv(name, value)


@slow
@pytest.mark.usefixtures("_in_own_domain")
def test_ros2(tmp_path: Path) -> None:
    pytest.importorskip("cyclonedds")
    pytest.importorskip("rosbags")
    output = example("09_ros2.py", tmp_path)
    assert "25 of 25 images are good" in output
    assert "pose of wrist_optical in tool0" in output
    assert "on /tf_static and /evercal/wrist_optical/pose" in output
    truth = json.loads((tmp_path / "virtual/truth.json").read_text("utf-8"))
    pose = truth["gripper_from_camera"]
    true = SE3(pose["quaternion_wxyz"], pose["translation_m"])
    assert pose_distance_mm_deg(read_transform(tmp_path / "ros2.json"), true)[0] < 0.5


@slow
def test_own_driver(tmp_path: Path) -> None:
    example("10_own_driver.py", tmp_path)
    assert len(load_recording(tmp_path / "driver").train) == 25
