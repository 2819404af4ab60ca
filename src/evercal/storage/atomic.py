"""Files and folders that appear whole or not at all.

Content is written to a sibling, synced and renamed; then the folder is synced. After a power cut
there is the old content or the new one, never a mixture.
"""

import contextlib
import json
import os
import shutil
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from evercal.typing import PathLike

_PATIENCE_S = {"win32": 2.0}.get(sys.platform, 0.0)
"""Time for other programs to close a file, seconds: Windows renames nothing that is open."""


def write_bytes(path: PathLike, data: bytes) -> None:
    """Create or replace a file.

    Raises:
        OSError: A full disk or no permission to write; the old file is then unchanged.
    """
    with replacing(path) as file:
        file.write(data)


@contextlib.contextmanager
def naming_file(path: PathLike) -> Iterator[None]:
    """Name a file in an error that names none: calls that notice a full disk know no path."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


@contextlib.contextmanager
def replacing(path: PathLike) -> Iterator[BinaryIO]:
    """Open a file that takes the place of `path` when the block ends without an error.

    Raises:
        OSError: As `write_bytes`.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with naming_file(path), open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        _rename(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    _sync_folder(path.parent)


def write_json(path: PathLike, obj: object) -> None:
    """Create or replace a UTF-8 JSON file; the same object gives the same bytes.

    Raises:
        ValueError: `obj` contains inf or nan, which JSON cannot represent.
        TypeError: `obj` contains another value that JSON cannot represent.
    """
    text = json.dumps(obj, indent=1, ensure_ascii=False, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def replace_folder(temporary: PathLike, final: PathLike) -> None:
    """Rename a complete folder, replacing an existing one.

    No portable call swaps two folders. An existing `final` is first renamed to a fixed name. After
    a crash between the two renames, `recover_folder` restores it.
    """
    temporary = Path(temporary)
    final = Path(final)
    for folder, _, names in os.walk(temporary):
        for name in names:
            _sync(Path(folder) / name)
        _sync_folder(Path(folder))
    recover_folder(final)
    aside = _aside(final)
    if final.exists():
        _rename(final, aside)
    try:
        _rename(temporary, final)
    except BaseException:
        recover_folder(final)
        raise
    _sync_folder(final.parent)
    shutil.rmtree(aside, ignore_errors=True)
    _sync_folder(final.parent)


def recover_folder(final: PathLike) -> None:
    """Restore or remove a folder that an interrupted `replace_folder` has left."""
    final = Path(final)
    aside = _aside(final)
    if not aside.exists():
        return
    if final.exists():
        shutil.rmtree(aside)
    else:
        _rename(aside, final)
    _sync_folder(final.parent)


def _rename(source: Path, target: Path) -> None:
    last = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return os.replace(source, target)
        except PermissionError as error:
            error.filename = str(target)
            if time.monotonic() >= last:
                raise
        time.sleep(_PATIENCE_S / 100)


def _aside(final: Path) -> Path:
    return final.with_name(f".{final.name}.replaced")


def _sync(file: Path) -> None:
    # Windows syncs no file that is open for reading only.
    with naming_file(file), open(file, "r+b") as handle:
        os.fsync(handle.fileno())


def _sync_folder(folder: Path) -> None:
    # An error is no refusal, as in SQLite: the rename is done, and some systems cannot sync it.
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
