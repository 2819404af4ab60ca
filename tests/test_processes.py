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
        worker.ask("a")
        assert worker.answer() == ([1, 2], "a")
        worker.ask("raise")
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


UNGUARDED = """
from evercal.processes import Worker, cause_of
def begin(state):
    return len
worker = Worker(begin, bytes(10**6))
worker.ask("a")
try:
    worker.answer()
except EOFError:
    print(cause_of(worker.end(patience_s=10.0)))
"""


def test_a_script_that_starts_workers_when_it_is_imported_ends(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    environment = {**os.environ, "PYTHONPATH": str(Path(processes.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, script],
        capture_output=True,
        text=True,
        env=environment,
        timeout=60,
    )
    assert "bootstrapping phase" in done.stderr
    assert "status 1, see the lines above; a script starts workers below" in done.stdout


COUNTED = """
from evercal.cli import main
from evercal.processes import cores
count = cores()
main(["info", "missing"])
import cv2, numpy, scipy.linalg
from threadpoolctl import threadpool_info
print(count, cv2.getNumThreads(), {pool["num_threads"] for pool in threadpool_info()})
"""


@pytest.mark.skipif(sys.platform != "linux", reason="affinity is set on Linux only")
def test_threads_are_as_many_as_the_process_may_use() -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(processes.__file__).parents[1])}
    del environment["OMP_NUM_THREADS"]
    mask = "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])"
    assert output_of_child(f"{mask}{COUNTED}", environment) == "1 1 {1}"
    environment["PYTHON_CPU_COUNT"] = "1"
    assert output_of_child(COUNTED, environment) == "1 1 {1}"


def output_of_child(code: str, environment: dict[str, str]) -> str:
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    return done.stdout.strip()


@pytest.mark.parametrize(
    ("quotas", "count"),
    [
        ({"": "max 100000", "pod": "max 100000", "pod/app": "200000 100000"}, 2),
        ({"pod": "150000 100000", "pod/app": "max 100000"}, 2),
        ({"": "50000 100000"}, 1),
        ({"pod": "300000 100000", "pod/app": "900000 100000"}, 3),
        ({"pod": "max 100000"}, 8),
        ({"pod": "broken"}, 8),
        ({}, 8),
    ],
)
def test_the_quota_of_a_container_bounds_the_threads(
    quotas: dict[str, str], count: int, tmp_path: Path, monkeypatch
) -> None:
    (tmp_path / "self").mkdir()
    lines = "1:cpu:/elsewhere\n0::/pod/app\n"
    (tmp_path / "self" / "cgroup").write_text(lines)
    for group, quota in quotas.items():
        (tmp_path / "groups" / group).mkdir(parents=True, exist_ok=True)
        (tmp_path / "groups" / group / "cpu.max").write_text(f"{quota}\n")
    monkeypatch.setattr(processes, "_PROC", tmp_path)
    monkeypatch.setattr(processes, "_CGROUPS", tmp_path / "groups")
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8), raising=False)
    for name in processes._COUNTS:
        monkeypatch.delenv(name, raising=False)
    assert processes.cores() == count
    monkeypatch.setenv("PYTHON_CPU_COUNT", "1")
    assert processes.cores() == 1
    monkeypatch.setenv("PYTHON_CPU_COUNT", "default")
    monkeypatch.setenv("OMP_NUM_THREADS", "0")
    monkeypatch.setenv("PYTHON_CPU_COUNT", "9" * 5000)
    assert processes.cores() == count
