"""Commands and Python of the README, tutorials and examples run as printed, in this process."""

import contextlib
import io
import json
import os
import re
import runpy
import shlex
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from docs._site.notebooks import NOTEBOOKS, Step, notebook_of, parts
from evercal.calibration.transform_file import read_transform
from evercal.cli import main
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.recordings import Recording, generic, samples

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "tutorials"
README = (ROOT / "README.md").read_text(encoding="utf-8")
pages = pytest.mark.slow("docs/tutorials", "docs/_site")
PORT = "8000"
"""Port on the pages; tests use a free one."""
LEARN = "evercal learn cell.evercal samples/cell/wrist --calibration wrist.json"
"""Runs once for all pages, in the fixture `cell`."""


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
            if step.kind == "text":
                continue
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


def test_a_wrist_camera_from_nothing(cell: Path, tmp_path: Path) -> None:
    assert LEARN in text_of("wrist-camera")
    printed = run(text_of("wrist-camera"), tmp_path, cell)
    shift = re.search(r"moved by ([\d.]+) mm", printed)
    assert shift is not None
    assert 4 < float(shift[1]) < 6
    assert (tmp_path / "wrist.urdf").is_file()
    assert (tmp_path / "report.html").is_file()


@pages
def test_a_camera_beside_the_robot(tmp_path: Path) -> None:
    printed = run(text_of("fixed-camera"), tmp_path)
    assert "The camera has not moved" in printed
    truth = json.loads((tmp_path / "robot/truth.json").read_text())["base_from_tripod"]
    true = SE3(truth["quaternion_wxyz"], truth["translation_m"])
    for name in ("tripod.json", "second.json"):
        assert pose_distance_mm_deg(read_transform(tmp_path / name), true)[0] < 2


@pages
@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_a_fleet(tmp_path: Path) -> None:
    pytest.importorskip("fastapi")
    pytest.importorskip("urllib3")
    printed = run(text_of("fleet"), tmp_path)
    assert '"status":"ok"' in printed.replace(" ", "")
    assert "kitchen [" in printed  # the answer of the client


@pages
def test_from_a_phone_video_to_a_calibrated_camera(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    printed = run(text_of("phone-video"), tmp_path)
    error = re.search(r"error ([\d.]+) mm, stated ([\d.]+) mm per axis", printed)
    assert error is not None
    assert float(error[1]) < 4 * float(error[2])
    assert float(error[1]) < 20


@pages
def test_a_method_of_your_own(tmp_path: Path) -> None:
    assert "mine" in run(text_of("own-method"), tmp_path)
    assert list((tmp_path / "results").glob("*.md"))


def example(name: str, *words: Path) -> str:
    """Run an example in this process; return what it prints."""
    script = str(ROOT / "examples" / name)
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(sys, "argv", [script, *map(str, words)])
        runpy.run_path(script, run_name="__main__")
    return printed.getvalue()


def test_first_example_locates_the_camera(
    arcs: tuple[Recording, Recording], tmp_path: Path
) -> None:
    generic.write(tmp_path / "one", arcs[0])
    output = example("01_learn_and_localize.py", tmp_path / "one")
    millimetres = re.search(r"error: ([\d.]+) mm", output)
    assert "scene: one" in output
    assert millimetres is not None
    assert float(millimetres[1]) < 5


@pytest.mark.slow("examples")
def test_second_example_calibrates_and_detects_the_bump(tmp_path: Path) -> None:
    output = example("02_calibrate.py", tmp_path)
    assert "pose of tripod_optical in base_link" in output
    shift = re.search(r"moved: True, ([\d.]+) mm", output)
    assert shift is not None
    assert 4 < float(shift[1]) < 6


@pages
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_run(name: str, tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat", reason="nbclient is not installed")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.reads(notebook_of(name), as_version=4)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        if "exit_code" in cell.metadata:
            cell.source += (
                f"\nassert _exit_code == {cell.metadata.exit_code}, _exit_code"
            )
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "evercal"
    program.write_text(
        f'#!/bin/sh\nexec "{sys.executable}" -m evercal "$@"\n', encoding="utf-8"
    )
    program.chmod(0o755)
    environment = child()
    environment["PATH"] = os.pathsep.join(
        [str(program.parent), environment.get("PATH", "")]
    )
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=1800, resources=resources).execute(
        env=environment
    )


def test_notebooks_hold_all_that_their_pages_hold() -> None:
    for name in NOTEBOOKS:
        cells = json.loads(notebook_of(name))["cells"]
        page = list(parts(text_of(name)))
        assert len(cells) == len(page)
        for cell, part in zip(cells, page, strict=True):
            assert (cell["cell_type"] == "markdown") == (part.kind == "text")
            if part.kind != "text":
                assert part.text.strip() in cell["source"]


def test_steps_are_read_in_order() -> None:
    page = "Text.\n\n    evercal check a b    # exit code 1: moved\n\n```python\nx = 1\n```\n"
    page += "```python my.py\ny = 2\n```\n    evercal serve a &\n"
    assert [part for part in parts(page) if part.kind != "text"] == [
        Step("command", "evercal check a b", 1),
        Step("python", "x = 1\n"),
        Step("my.py", "y = 2\n"),
        Step("command", "evercal serve a &"),
    ]


def test_every_page_has_a_test() -> None:
    tested = {"wrist-camera", "fixed-camera", "phone-video", "fleet", "own-method"}
    assert {path.stem for path in PAGES.glob("*.md")} == tested
