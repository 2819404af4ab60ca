"""A writer that is killed at any step leaves the old content or the new one."""

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from evercal.storage import recover_folder, replace_folder, write_bytes, write_json

# In a child for each folder, which dies without any clean-up, as from a power cut, at the call that
# touches the disk: the first child at the first call, the second one at the second.
DYING = """
import os, shutil, sys
from evercal.storage import atomic
left = 0
def dying(function):
    def call(*args, **kwargs):
        global left
        left -= 1
        if left == 0:
            os._exit(9)
        return function(*args, **kwargs)
    return call
os.fsync, os.replace = dying(os.fsync), dying(os.replace)
shutil.rmtree = dying(shutil.rmtree)
for step, root in enumerate(sys.argv[2:], 1):
    child = os.fork()
    if not child:
        left = step
        exec(sys.argv[1])
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
STEPS = 25


def require_old_or_new(root: Path, code: str, content: Callable[[Path], str]) -> None:
    """Run `code` in the folders of `root`, which say `old` or, from one step on, `new`."""
    folders = [root / str(step) for step in range(STEPS)]
    command = [sys.executable, "-c", DYING, code, *map(str, folders)]
    statuses = subprocess.check_output(command, text=True, timeout=60).split()
    killed = statuses.count("9")
    assert statuses == ["9"] * killed + ["0"] * (STEPS - killed)
    assert 3 <= killed < STEPS  # fsync, replace, fsync at the least
    outcomes = [content(folder) for folder in folders]
    assert outcomes[0] == "old"
    assert {*outcomes} == {"old", "new"}
    assert {*outcomes[killed:]} == {"new"}


def test_a_file_is_old_or_new_at_every_step(tmp_path: Path) -> None:
    for step in range(STEPS):
        (tmp_path / str(step)).mkdir()
        (tmp_path / str(step) / "head").write_text("old")
    code = "atomic.write_bytes(root + '/head', b'new')"
    require_old_or_new(tmp_path, code, lambda root: (root / "head").read_text())


def test_a_folder_is_old_or_new_at_every_step(tmp_path: Path) -> None:
    for step in range(STEPS):
        for name, text in (("stage", "old"), ("fresh", "new")):
            folder = tmp_path / str(step) / name
            (folder / "deep").mkdir(parents=True)
            (folder / "a").write_text(text)
            (folder / "deep/b").write_text(text)

    def content(root: Path) -> str:
        recover_folder(root / "stage")
        assert not list(root.glob(".*"))
        text = (root / "stage/a").read_text()
        assert (root / "stage/deep/b").read_text() == text
        return text

    code = "atomic.replace_folder(root + '/fresh', root + '/stage')"
    require_old_or_new(tmp_path, code, content)


def test_a_failed_write_leaves_the_old_file_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a"
    write_bytes(file, b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space") as error:
        write_bytes(file, b"new")
    assert error.value.filename == str(file)
    assert file.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a"]


def test_a_folder_that_cannot_be_replaced_stays(
    tmp_path: Path, full_disk: Callable[..., AbstractContextManager[list[str]]]
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
    data = (tmp_path / "a").read_bytes()
    assert "é".encode() in data
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a", {"x": float("nan")})
    assert (tmp_path / "a").read_bytes() == data
    write_json(tmp_path / "a", obj)
    assert (tmp_path / "a").read_bytes() == data
