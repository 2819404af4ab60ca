"""Commands and Python of the README, tutorials and examples run as printed, in this process."""

import contextlib
import io
import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.transform_file import read_transform
from evercal.cli import main
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.recordings import generic, samples
from tests import arm_cell

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "tutorials"
README = (ROOT / "README.md").read_text(encoding="utf-8")
pages = pytest.mark.slow("docs/tutorials", "docs/_site")
PORT = "8000"
"""Port on the pages; tests use a free one."""
LEARN = "evercal learn cell.evercal samples/cell/wrist --calibration wrist.json"
"""Runs once for all pages, in the fixture `cell`."""

_BLOCK = re.compile(r"^```python *(\S*)\n(.*?)^```$|^    (\S[^\n]*)$", re.M | re.S)


@dataclass(frozen=True)
class Step:
    """A part of a page."""

    kind: str
    """`command`, `python`, or the name of the file that a block is saved as."""
    text: str
    code: int = 0
    """Expected exit code of a command."""


def parts(page: str) -> Iterator[Step]:
    """Commands and blocks of Python of a page, in its order."""
    for block in _BLOCK.finditer(page):
        name, code, command = block.groups()
        if command is None:
            yield Step(name or "python", code)
            continue
        line, _, comment = command.partition("  # ")
        stated = re.match(r"\s*exit code (\d+)", comment)
        yield Step("command", line.strip(), int(stated[1]) if stated else 0)


def text_of(name: str) -> str:
    return (PAGES / f"{name}.md").read_text(encoding="utf-8")


def child() -> dict[str, str]:
    """The environment of child processes."""
    path = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    return {**os.environ, "PYTHONPATH": path}


@contextlib.contextmanager
def serving(words: list[str], folder: Path) -> Iterator[None]:
    """A command in the background, by the real entry point."""
    command = [sys.executable, "-m", *words]
    with subprocess.Popen(command, cwd=folder, env=child()) as service:
        yield
        service.terminate()


def run_step(step: Step) -> int | str | None:
    """Run a command or a block of Python here; return the exit code."""
    if step.kind == "python":
        exec(compile(step.text, "page", "exec"), {"__name__": "__main__"})
        return 0
    program, *words = shlex.split(step.text)
    if program == "curl":
        command = [program, *words]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        print(done.stdout)  # noqa: T201
        return 0
    assert program == "evercal", step.text
    return main(words)


def run(page: str, folder: Path, cell: Path | None = None) -> str:
    """Run the steps of a page in a folder; return what they print."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        page = page.replace(PORT, str(listening.getsockname()[1]))
    printed = io.StringIO()
    with contextlib.ExitStack() as around:
        around.enter_context(contextlib.chdir(folder))
        around.enter_context(contextlib.redirect_stdout(printed))
        for step in parts(page):
            if step.kind not in ("command", "python"):
                (folder / step.kind).write_text(step.text, encoding="utf-8")
            elif step.text.endswith("&"):
                around.enter_context(serving(shlex.split(step.text)[:-1], folder))
            elif step.text == LEARN and cell is not None:
                shutil.copytree(cell, folder, dirs_exist_ok=True)
            else:
                assert run_step(step) == step.code, step.text
    return printed.getvalue()


def thinned(scene: Path, folder: Path, train: int, test: int) -> Path:
    """A copy of a packaged room that has only every so many images of each split."""
    shutil.copytree(scene, folder / scene.name)
    file = folder / scene.name / generic.FILE
    content = json.loads(file.read_text(encoding="utf-8"))
    splits = [
        [f for f in content["frames"] if f["split"] == s] for s in ("train", "test")
    ]
    content["frames"] = splits[0][::train] + splits[1][::test]
    file.write_text(json.dumps(content), encoding="utf-8")
    return folder


def test_python_of_the_readme_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rooms = thinned(samples.FOLDER / "bedroom", tmp_path / "rooms", 2, 3)
    monkeypatch.setattr(samples, "FOLDER", rooms)
    lines = run(
        README.partition("## Python")[2].partition("\n## ")[0], tmp_path
    ).splitlines()
    assert lines[0] == "bedroom"
    assert (tmp_path / "cell.evercal" / "manifest.json").is_file()
    assert (tmp_path / "tripod.yml").read_text().count(":") > 10
    assert any(re.match(r"True [45]\.\d+", line) for line in lines)  # bumped by 5 mm
    assert float(lines[-1]) > 80


def test_commands_of_the_readme_run_on_the_packaged_cell(
    cell: Path, tmp_path: Path
) -> None:
    section = README.partition("## Command line")[2].partition("\n## ")[0]
    assert LEARN in section
    before, video = section.partition("    evercal localize")[::2]
    run(before, tmp_path, cell)
    for image in sorted((tmp_path / "samples/cell/wrist/images").iterdir())[6:]:
        image.unlink()  # drawing takes long
    run(f"    evercal localize{video}", tmp_path)
    assert {"report.html", "located.mp4"} <= {path.name for path in tmp_path.iterdir()}
    truth = json.loads((tmp_path / "samples/cell/truth.json").read_text("utf-8"))
    for file, name in (
        ("wrist.json", "gripper_from_camera"),
        ("tripod.json", "base_from_camera"),
    ):
        true = SE3(
            *(
                np.array(truth[name][key])
                for key in ("quaternion_wxyz", "translation_m")
            )
        )
        millimetres, degrees = pose_distance_mm_deg(
            read_transform(tmp_path / file), true
        )
        assert millimetres < 2
        assert degrees < 0.1


@pages
def test_a_camera_beside_the_robot(tmp_path: Path) -> None:
    printed = run(text_of("fixed-camera"), tmp_path)
    assert "The camera has not moved" in printed
    truth = json.loads((tmp_path / "robot/truth.json").read_text())["base_from_tripod"]
    true = SE3(truth["quaternion_wxyz"], truth["translation_m"])
    for name in ("tripod.json", "second.json"):
        assert pose_distance_mm_deg(read_transform(tmp_path / name), true)[0] < 2


def test_the_arm_alone(tmp_path: Path) -> None:
    arm_cell.write(tmp_path / "recording")
    arm_cell.write(tmp_path / "new", 5, seed=1)
    printed = run(text_of("arm-in-view"), tmp_path)
    assert "The camera has not moved" in printed
    assert "No joint has changed" in printed
    pose = read_transform(tmp_path / "camera.json")
    assert pose_distance_mm_deg(pose, arm_cell.BASE_FROM_CAMERA)[0] < 2
    assert (tmp_path / "camera.html").is_file()


@pages
def test_a_method_of_your_own(tmp_path: Path) -> None:
    assert "mine" in run(text_of("own-method"), tmp_path)
    assert list((tmp_path / "results").glob("*.md"))


def test_steps_are_read_in_order() -> None:
    page = "Text.\n\n    evercal check a b    # exit code 1: moved\n\n```python\nx = 1\n```\n"
    page += "```python my.py\ny = 2\n```\n    evercal serve a &\n"
    assert list(parts(page)) == [
        Step("command", "evercal check a b", 1),
        Step("python", "x = 1\n"),
        Step("my.py", "y = 2\n"),
        Step("command", "evercal serve a &"),
    ]


def test_every_page_has_a_test() -> None:
    tested = {"fixed-camera", "arm-in-view", "own-method"}
    assert {path.stem for path in PAGES.glob("*.md")} == tested
