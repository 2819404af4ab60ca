"""Files and folders that appear whole or not at all.

Everything is written to a sibling, synced, moved into place by one rename, and the folder that
holds it is synced too, so that after a power cut there is the old content or the new, never half.
"""

import contextlib
import json
import os
import shutil
import uuid
from pathlib import Path


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Creates or replaces a file with `data`.

    Raises:
        OSError: As the system says (full disk, no right to write); the old file is then untouched.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    _sync_folder(path.parent)


def write_json(path: str | os.PathLike[str], obj: object) -> None:
    """Creates or replaces a file with `obj` as UTF-8 JSON; the same object gives the same bytes.

    Raises:
        ValueError: `obj` holds inf or nan, which JSON has no word for.
        TypeError: `obj` holds something that JSON has no word for.
    """
    text = json.dumps(obj, indent=1, ensure_ascii=False, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def replace_folder(temporary: str | os.PathLike[str], final: str | os.PathLike[str]) -> None:
    """Moves a finished folder to its place, replacing what stood there.

    Systems cannot swap two folders in one portable step. If `final` exists it is first set aside
    under a fixed name; a crash between the two renames is mended by `recover_folder`.

    Args:
        temporary: A folder on the same file system, complete; it is synced here.
        final: Where it goes.
    """
    temporary, final = Path(temporary), Path(final)
    for folder, _, names in os.walk(temporary):
        for name in names:
            _sync(Path(folder) / name)
        _sync_folder(Path(folder))
    recover_folder(final)
    aside = _aside(final)
    if final.exists():
        os.replace(final, aside)
    os.replace(temporary, final)
    _sync_folder(final.parent)
    if aside.exists():
        shutil.rmtree(aside)
        _sync_folder(final.parent)


def recover_folder(final: str | os.PathLike[str]) -> None:
    """Brings back or clears away what an interrupted `replace_folder` left; else does nothing."""
    final = Path(final)
    aside = _aside(final)
    if not aside.exists():
        return
    if final.exists():
        shutil.rmtree(aside)
    else:
        os.replace(aside, final)
    _sync_folder(final.parent)


def _aside(final: Path) -> Path:
    return final.with_name(f".{final.name}.replaced")


def _sync(file: Path) -> None:
    with open(file, "rb") as handle:
        os.fsync(handle.fileno())


def _sync_folder(folder: Path) -> None:
    """Makes renames in `folder` last; not every system lets a folder be opened."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
