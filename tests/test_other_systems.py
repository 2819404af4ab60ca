"""What other systems than Linux lack, refuse or do another way; none of them is at hand."""

from __future__ import annotations

import ast
import os
import resource
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from evercal import processes
from evercal.features.encoder import load_encoder
from evercal.processes import command_line
from evercal.storage import atomic, tensors, write_bytes
from evercal.storage.text_files import is_link

SOURCE = Path(processes.__file__).parent

LACKING = """
import importlib, os, pkgutil, signal, sys
import filelock, multiprocessing.popen_spawn_posix
for name in ("fork", "getuid", "killpg", "sched_getaffinity", "setsid"):
    delattr(os, name)
for name in ("SIGALRM", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGUSR1", "alarm", "setitimer"):
    delattr(signal, name)
sys.modules |= dict.fromkeys(("fcntl", "grp", "pwd", "resource", "termios"))
import evercal
for module in pkgutil.walk_packages(evercal.__path__, "evercal."):
    if not module.name.startswith("evercal.continual") and "__main__" not in module.name:
        importlib.import_module(module.name)
"""


def test_every_module_loads_without_what_windows_lacks() -> None:
    environment = {**os.environ, "PYTHONPATH": str(SOURCE.parent)}
    command = [sys.executable, "-c", LACKING]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr


def test_windows_has_all_cores_and_its_own_quotes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = ["evercal", "info", r"C:\my maps\a.evercal"]
    assert command_line(words) == r"evercal info 'C:\my maps\a.evercal'"
    monkeypatch.setattr(processes, "sys", SimpleNamespace(platform="win32"))
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.delenv("OMP_NUM_THREADS")
    monkeypatch.setattr(processes, "_quotas", lambda: [])
    assert processes.cores() == os.cpu_count()
    assert command_line(words) == r'evercal info "C:\my maps\a.evercal"'


def test_a_file_that_another_program_reads_is_replaced_soon_or_named(
    tmp_path: Path, windows: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "manifest.json"
    path.write_bytes(b"old")
    reader = path.open("rb")
    monkeypatch.setattr(atomic.time, "sleep", lambda _: reader.close())
    with pytest.raises(PermissionError) as error:
        write_bytes(path, b"new")
    assert (error.value.filename, path.read_bytes()) == (str(path), b"old")
    monkeypatch.setattr(atomic, "_PATIENCE_S", 30.0)
    write_bytes(path, b"new")
    assert reader.closed
    assert path.read_bytes() == b"new"
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_as_many_files_are_opened_as_the_system_allows(
    system: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = []

    def set_limit(kind: int, limit: tuple[int, int]) -> None:
        if limit[0] > 10_240:
            raise ValueError("current limit exceeds maximum limit")
        limits.append(limit[0])

    monkeypatch.setattr(resource, "getrlimit", lambda _: (256, 2**63 - 1))
    monkeypatch.setattr(resource, "setrlimit", set_limit)
    monkeypatch.setattr(tensors, "sys", SimpleNamespace(platform=system))
    tensors._open_more_files()
    assert limits == ([10_240] if system == "darwin" else [])


def _opens_text_of_the_locale(call: ast.Call) -> bool:
    """Whether a call reads or writes text in the encoding that the system prefers."""
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    keywords = {keyword.arg for keyword in call.keywords}
    words = [a.value for a in call.args if isinstance(a, ast.Constant)]
    if name == "open":
        modes = [w for w in words if isinstance(w, str) and set(w) <= set("rwxabt+")]
        opens = isinstance(call.func, ast.Name) or bool(modes)
        opens = opens and not ast.unparse(call.func).startswith("archive.")  # bytes
        return opens and "encoding" not in keywords and not any("b" in m for m in modes)
    if isinstance(call.func, ast.Attribute) and name in ("read_text", "write_text"):
        return "encoding" not in keywords and "utf-8" not in words
    return name in ("run", "Popen", "check_output") and "text" in keywords


def test_text_is_utf8_on_every_system() -> None:
    found = []
    for file in sorted(SOURCE.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Call) and _opens_text_of_the_locale(node):
                found.append(f"{file.relative_to(SOURCE)}:{node.lineno}")
    assert found == []
    for bad in ("path.read_text()", "open(p)", "p.open('w')", "s.run(c, text=True)"):
        call = ast.parse(bad, mode="eval").body
        assert isinstance(call, ast.Call)
        assert _opens_text_of_the_locale(call)


def test_a_network_is_read_where_opencv_opens_no_such_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grey = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    expected = load_encoder().encode(grey, 48)
    read = cv2.dnn.readNetFromONNX

    def of_windows(source: str | np.ndarray, engine: int) -> object:
        if isinstance(source, str) and not source.isascii():
            raise cv2.error(f"Can't read ONNX file: {source}")
        return read(source, engine=engine)  # pyright: ignore

    monkeypatch.setattr(cv2.dnn, "readNetFromONNX", of_windows)
    folder = tmp_path / "Jürgen"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    assert np.allclose(load_encoder().encode(grey, 48), expected, atol=1e-4)


def test_a_junction_is_a_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "images").symlink_to(tmp_path / "elsewhere")
    monkeypatch.setattr(Path, "is_symlink", lambda _: False)
    assert is_link(tmp_path / "images")
    assert not is_link(tmp_path / "elsewhere")
    assert not is_link(tmp_path / "missing")
