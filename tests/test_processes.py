"""Processes: none imports from the current folder, which may hold any file, and all are started
in one place."""

import ast
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from evercal import processes
from evercal.processes import Worker, cause_of, output_of, python_command, status_of

ROOT = Path(__file__).parents[1]
HOME = ROOT / "src" / "evercal" / "processes.py"
MODULES = {"subprocess", "multiprocessing", "pty", "runpy", "popen2"}
CALLS = {
    "ProcessPoolExecutor", "Popen", "fork", "forkpty", "popen", "posix_spawn", "posix_spawnp",
    "spawn", "startfile", "system", "create_subprocess_exec", "create_subprocess_shell",
    "executable",
}  # fmt: skip


def starts(file: Path) -> list[str]:
    """What a module uses that could start a process."""
    lines = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name.split(".")[0] for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = (node.module or "").split(".")
            names = [module[0], module[-1], *(alias.name for alias in node.names)]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            owner = node.value.id
            told = (
                owner in ("os", "sys", "asyncio", "mp")
                or node.attr == "ProcessPoolExecutor"
            )
            names = [node.attr] if told else []
            if owner == "os" and node.attr.startswith(("exec", "spawn")):
                names.append("system")
        lines += [f"{file.name}:{name}" for name in names if name in MODULES | CALLS]
    return lines


def test_processes_are_started_in_one_module() -> None:
    folders = ("src/evercal", "rooms", "training")
    files = {file for folder in folders for file in (ROOT / folder).rglob("*.py")} - {
        HOME
    }
    assert len(files) > 150
    assert [line for file in sorted(files) for line in starts(file)] == []
    assert len(starts(HOME)) > 3  # it recognises what it looks for


BAIT = "import pathlib; pathlib.Path(__file__).with_suffix('.ran').touch()\n"


@pytest.fixture
def baited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with modules named as those that processes import."""
    for name in (
        "pycolmap",
        "socket",
        "pickle",
        "selectors",
        "runpy",
        "torch",
        "cv2",
        "tyro",
    ):
        (tmp_path / f"{name}.py").write_text(BAIT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_python_code_imports_nothing_from_the_current_folder(baited: Path) -> None:
    assert status_of("import socket, runpy; raise SystemExit(7)", seconds=60) == 7
    assert status_of("print(flush=True)\nwhile True: pass", seconds=0.5) is None
    assert output_of(*python_command("-c", "import pickle; print('done')")) == "done"
    assert not list(baited.glob("*.ran"))


def _begin(state: object) -> object:
    import socket  # noqa: F401

    def work(request: str) -> tuple[object, str]:
        if request == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if request == "exit":
            os._exit(3)
        if request == "raise":
            raise KeyError("request")
        return state, request

    return work


def test_workers_import_nothing_from_the_current_folder_and_state_why_they_end(
    baited: Path,
) -> None:
    ends = {}
    for request in ("kill", "exit"):
        worker = Worker(_begin, [1, 2])  # pyright: ignore[reportArgumentType]
        assert worker.ask("a")
        assert worker.answer() == ([1, 2], "a")
        assert worker.ask("raise")
        with pytest.raises(KeyError, match="request") as error:
            worker.answer()
        assert "in work" in error.value.__notes__[0]
        worker.ask(request)
        with pytest.raises(EOFError):
            worker.answer()
        ends[request] = cause_of(worker.end(patience_s=10.0))
    assert ends["kill"] == "its process was killed by SIGKILL; is there enough memory?"
    assert ends["exit"] == "its process ended with status 3, see the lines above"
    assert not list(baited.glob("*.ran"))
    assert "PYTHONSAFEPATH" not in os.environ


def test_the_command_line_imports_nothing_from_the_current_folder(baited: Path) -> None:
    (baited / "sparse" / "0").mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (baited / "sparse" / "0" / f"{name}.bin").write_bytes(bytes(16))
    (baited / "runpy.py").unlink()  # Python itself imports it before any module of ours
    command = [sys.executable, "-m", "evercal", "inspect", "."]
    environment = {**os.environ, "PYTHONPATH": str(Path(processes.__file__).parents[1])}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert not list(baited.glob("*.ran"))
