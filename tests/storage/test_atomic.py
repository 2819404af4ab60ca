"""A writer that is killed at any step leaves the old content or the new one."""

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from evercal.storage import recover_folder, replace_folder, write_bytes, write_json

# Dies without any clean-up, as from a power cut, at the n-th call that touches the disk.
DIE_AT = """
import os, shutil, sys
from evercal.storage import atomic
left = [int(sys.argv[1])]
def dying(function):
    def call(*args, **kwargs):
        left[0] -= 1
        if left[0] == 0:
            os._exit(9)
        return function(*args, **kwargs)
    return call
os.fsync, os.replace = dying(os.fsync), dying(os.replace)
shutil.rmtree = dying(shutil.rmtree)
root = sys.argv[2]
"""


def die_at(step: int, root: Path, code: str) -> bool:
    """Runs `code`; whether it was killed before its end."""
    command = [sys.executable, "-c", DIE_AT + code, str(step), str(root)]
    status = subprocess.run(command, check=False, timeout=60).returncode
    assert status in (0, 9)
    return status == 9


def test_a_file_is_old_or_new_at_every_step(tmp_path: Path) -> None:
    file = tmp_path / "head.bin"
    outcomes = []
    killed = True
    step = 0
    for step in range(1, 20):
        file.write_bytes(b"old")
        killed = die_at(
            step, tmp_path, "atomic.write_bytes(root + '/head.bin', b'new' * 1000)"
        )
        outcomes.append(file.read_bytes())
        assert outcomes[-1] in (b"old", b"new" * 1000)
        if not killed:
            break
    assert not killed
    assert step >= 3  # fsync, replace, fsync at the least
    assert outcomes[0] == b"old"
    assert outcomes[-1] == b"new" * 1000


def test_a_folder_is_old_or_new_at_every_step(tmp_path: Path) -> None:
    code = "atomic.replace_folder(root + '/fresh', root + '/stage')"
    outcomes = []
    killed = True
    for step in range(1, 30):
        root = tmp_path / str(step)
        for name, text in (("stage", "old"), ("fresh", "new")):
            (root / name / "deep").mkdir(parents=True)
            (root / name / "a").write_text(text)
            (root / name / "deep/b").write_text(text)
        killed = die_at(step, root, code)
        recover_folder(root / "stage")
        content = (root / "stage/a").read_text(), (root / "stage/deep/b").read_text()
        outcomes.append(content)
        assert content in (("old", "old"), ("new", "new"))
        assert not list(root.glob(".*"))
        if not killed:
            break
    assert not killed
    assert outcomes[0] == ("old", "old")
    assert outcomes[-1] == ("new", "new")


def test_a_failed_write_leaves_the_old_file_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a"
    write_bytes(file, b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_bytes(file, b"new")
    assert file.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a"]


def test_a_folder_that_cannot_be_replaced_stays(
    tmp_path: Path, full_disk: Callable[..., AbstractContextManager[list[int]]]
) -> None:
    for name in ("fresh", "stage"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text(name)
    # The folder and its file are synced, and the old folder is renamed.
    with full_disk(4, once=True), pytest.raises(OSError, match="No space"):
        replace_folder(tmp_path / "fresh", tmp_path / "stage")
    assert sorted(os.listdir(tmp_path)) == ["fresh", "stage"]
    assert (tmp_path / "stage/a").read_text() == "stage"


def test_a_folder_is_created(tmp_path: Path) -> None:
    (tmp_path / "fresh").mkdir()
    write_bytes(tmp_path / "fresh/a", b"1")
    replace_folder(tmp_path / "fresh", tmp_path / "stage")
    assert os.listdir(tmp_path) == ["stage"]
    recover_folder(tmp_path / "stage")
    assert (tmp_path / "stage/a").read_bytes() == b"1"


def test_json_is_the_same_bytes_each_time_and_has_no_nan(tmp_path: Path) -> None:
    obj = {"é": [1, 2.5, None, True], "a": {"b": "c"}}
    write_json(tmp_path / "a", obj)
    write_json(tmp_path / "b", obj)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert "é" in (tmp_path / "a").read_text(encoding="utf-8")
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a", {"x": float("nan")})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
