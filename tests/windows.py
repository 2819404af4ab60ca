"""A fixture that refuses what Windows refuses: files of this process that are open or mapped.

It is no Windows; it stands for what its documentation states.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

_NAMED = {"replace": 2, "rename": 2, "unlink": 1, "remove": 1, "rmdir": 1}
"""Calls that change names, and how many of their arguments are names."""


def held(path: object) -> list[str]:
    """Files below a path, or the path itself, that this process has open or mapped."""
    names = set()
    for entry in os.scandir("/proc/self/fd"):
        try:
            names.add(os.readlink(entry.path))
        except FileNotFoundError:  # that of the folder
            continue
    for line in Path("/proc/self/maps").read_text("utf-8").splitlines():
        names.update(line.split(maxsplit=5)[5:])
    top = os.path.realpath(str(path))
    return sorted(name for name in names if f"{name}/".startswith(f"{top}/"))


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing that is open is renamed or removed, nor synced if it is open for reading only."""
    if not Path("/proc/self/maps").exists():
        pytest.skip("open files are listed on Linux only")
    sync = os.fsync
    open_file = os.open

    def refusing(call: Callable[..., object], count: int) -> Callable[..., object]:
        def refuse(*paths: object, **how: object) -> object:
            for path in paths[:count]:
                if held(path):
                    raise PermissionError(errno.EACCES, "is being used", str(path))
            return call(*paths, **how)

        return refuse

    def fsync(descriptor: int) -> None:
        if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        sync(descriptor)

    def opened(path: str, *how: int) -> int:
        if os.path.isdir(path):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return open_file(path, *how)

    for name, count in _NAMED.items():
        monkeypatch.setattr(os, name, refusing(getattr(os, name), count))
    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "open", opened)
    monkeypatch.setattr(shutil, "_use_fd_functions", False)
