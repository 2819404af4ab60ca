"""Every command and every block of Python on a tutorial page runs as printed.

The two main tutorials run as the notebooks that are made from their pages.
"""

import contextlib
import json
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from docs._site.notebooks import NOTEBOOKS, Step, notebook_of, parts

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "tutorials"
slow = pytest.mark.slow("docs/tutorials", "docs/_site")
PORT = "8000"
"""Port on the pages; tests use a free one."""
TIMEOUT_S = 1800


def steps(page: str) -> Iterator[Step]:
    """Commands and blocks of a page, in its order."""
    return (part for part in parts(page) if part.kind != "text")


def free_port() -> str:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return str(listening.getsockname()[1])


def run(name: str, folder: Path) -> str:
    """Run a page in a folder; return what its steps print."""
    page = (PAGES / f"{name}.md").read_text(encoding="utf-8").replace(PORT, free_port())
    path = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHON": sys.executable}
    printed = ""
    with contextlib.ExitStack() as background:
        for step in steps(page):
            if step.kind not in ("command", "python"):
                (folder / step.kind).write_text(step.text, encoding="utf-8")
                continue
            words = [sys.executable, "-c", step.text]
            if step.kind == "command":
                program, _, rest = step.text.partition(" ")
                assert program in ("evercal", "curl"), step.text
                is_ours = program == "evercal"
                shell = f'"$PYTHON" -m evercal {rest}' if is_ours else step.text
                words = ["bash", "-c", f"exec {shell.removesuffix('&')}"]
            if step.text.endswith("&"):
                service = subprocess.Popen(words, cwd=folder, env=environment)
                background.callback(service.wait)
                background.callback(service.terminate)
                continue
            done = subprocess.run(
                words,
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                timeout=TIMEOUT_S,
            )
            assert done.returncode == step.code, f"{step.text}\n{done.stdout}{done.stderr}"
            printed += done.stdout
    return printed


def test_steps_are_read_in_order() -> None:
    page = "Text.\n\n    evercal check a b    # exit code 1: moved\n\n```python\nx = 1\n```\n"
    page += "```python my.py\ny = 2\n```\n    evercal serve a &\n"
    assert list(steps(page)) == [
        Step("command", "evercal check a b", 1),
        Step("python", "x = 1\n"),
        Step("my.py", "y = 2\n"),
        Step("command", "evercal serve a &"),
    ]


def test_every_page_has_a_test() -> None:
    tested = {"wrist-camera", "phone-video", "fleet", "own-method"}
    assert {path.stem for path in PAGES.glob("*.md")} == tested


def run_notebook(name: str, folder: Path) -> str:
    """Run a page's notebook in a folder; return what its cells print."""
    nbformat = pytest.importorskip("nbformat", reason="nbclient is not installed")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.reads(notebook_of(name), as_version=4)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        if "exit_code" in cell.metadata:
            cell.source += f"\nassert _exit_code == {cell.metadata.exit_code}, _exit_code"
    (folder / "bin").mkdir()
    program = folder / "bin" / "evercal"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m evercal "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    environment = {
        **os.environ,
        "PATH": os.pathsep.join([str(program.parent), os.environ.get("PATH", "")]),
        "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]),
    }
    client = nbclient.NotebookClient(
        notebook, timeout=TIMEOUT_S, resources={"metadata": {"path": str(folder)}}
    )
    client.execute(env=environment)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return "".join(output.get("text", "") for output in outputs)


def test_notebooks_hold_all_that_their_pages_hold() -> None:
    for name in NOTEBOOKS:
        cells = json.loads(notebook_of(name))["cells"]
        page = list(parts((PAGES / f"{name}.md").read_text(encoding="utf-8")))
        assert len(cells) == len(page)
        for cell, part in zip(cells, page, strict=True):
            assert (cell["cell_type"] == "markdown") == (part.kind == "text")
            if part.kind != "text":
                assert part.text.strip() in cell["source"]


@slow
def test_a_wrist_camera_from_nothing(tmp_path: Path) -> None:
    printed = run_notebook("wrist-camera", tmp_path)
    shift = re.search(r"moved by ([\d.]+) mm", printed)
    assert shift is not None
    assert 4 < float(shift[1]) < 6
    assert (tmp_path / "wrist.calib").is_file()
    assert (tmp_path / "report.html").is_file()


@slow
@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_a_fleet(tmp_path: Path) -> None:
    pytest.importorskip("fastapi")
    pytest.importorskip("urllib3")
    printed = run("fleet", tmp_path)
    assert '"status":"ok"' in printed.replace(" ", "")
    assert "kitchen [" in printed  # the answer of the client


@slow
def test_from_a_phone_video_to_a_calibrated_camera(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    printed = run_notebook("phone-video", tmp_path)
    error = re.search(r"error ([\d.]+) mm, stated ([\d.]+) mm per axis", printed)
    assert error is not None
    assert float(error[1]) < 4 * float(error[2])
    assert float(error[1]) < 20


@slow
def test_a_method_of_your_own(tmp_path: Path) -> None:
    printed = run("own-method", tmp_path)
    assert "mine" in printed
    assert list((tmp_path / "results").glob("*.md"))
