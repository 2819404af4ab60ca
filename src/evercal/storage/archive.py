"""Zip archives of folders: written as one file, and extracted without trust in their content."""

import contextlib
import errno
import shutil
import stat
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath

from evercal.bounds import require_at_most
from evercal.errors import InputError
from evercal.storage.atomic import naming_file, replacing
from evercal.typing import PathLike

_DIRECTORY_BYTES = 512
"""Size of an entry in the central directory, bytes, on average and at most: Python keeps all
entries in memory before any of them can be checked."""
_CHUNK = 1 << 20
"""Bytes that are copied at a time."""
_SAME_TIME = (1980, 1, 1, 0, 0, 0)
"""Date of all entries: the earliest that a zip archive can state."""
_BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    ValueError,
    NotImplementedError,
)
"""Errors of the library while it reads a damaged archive."""


def write_archive(file: PathLike, root: Path, names: Iterable[str]) -> None:
    """Write files of a folder into one zip archive, whole or not at all.

    Entries are stored, not compressed: JPEG images and half floats hardly shrink. The same files
    give the same bytes.

    Args:
        file: The archive; an existing one is replaced.
        root: Folder of the files.
        names: Paths relative to `root`, with forward slashes.

    Raises:
        OSError: A missing file, a full disk or no permission to write.
    """
    with replacing(file) as out, zipfile.ZipFile(out, "w") as archive:
        for name in names:
            entry = zipfile.ZipInfo(name, _SAME_TIME)
            entry.external_attr = (stat.S_IFREG | 0o644) << 16
            path = root / name
            # Above 2 GiB the header is longer.
            entry.file_size = path.stat().st_size
            with open(path, "rb") as source, archive.open(entry, "w") as target:
                shutil.copyfileobj(source, target, _CHUNK)


def check_archive(file: Path) -> dict[str, int]:
    """Check the entries of a zip archive without extracting them.

    Returns:
        Path and size of every file, bytes.
    """
    with _opened(file) as archive:
        entries = _checked(archive, file)
        return {e.filename: e.file_size for e in entries if not e.is_dir()}


def read_entry(file: Path, name: str, most: int) -> bytes:
    """Read one file of a zip archive, of at most so many bytes."""
    with _opened(file) as archive:
        size = archive.getinfo(name).file_size
        if size > most:
            raise InputError(f"{file}: {name} has {size:,} bytes, at most {most:,}")
        return archive.read(name)


def extract_archive(file: Path, folder: Path) -> None:
    """Extract a zip archive into a folder that does not exist yet.

    Sizes are checked twice: as the archive states them, and while the files are written.
    """
    folder.mkdir(parents=True)
    with _opened(file) as archive:
        for entry in _checked(archive, file):
            path = folder / entry.filename
            if entry.is_dir():
                path.mkdir(parents=True, exist_ok=True)
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            _extract(archive, entry, path)


@contextlib.contextmanager
def _opened(file: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(_bounded(file)) as archive:
            yield archive
    except (*_BROKEN, OSError) as error:
        # A broken offset is an invalid argument of a system call.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise
        raise InputError(f"{file}: not a readable zip archive ({error})") from None


def _bounded(file: Path) -> Path:
    with open(file, "rb") as opened:
        # The library's own search, so that both find the same directory.
        end = zipfile._EndRecData(opened)  # pyright: ignore[reportAttributeAccessIssue]
    if not end:
        raise InputError(f"{file}: not a zip archive")
    entries, directory_bytes = end[4:6]
    count = max(entries, directory_bytes // _DIRECTORY_BYTES)
    _require_at_most(file, count, "archive_files", "entries")
    return file


def _require_at_most(file: Path, count: int, name: str, what: str) -> None:
    try:
        require_at_most(count, name, what)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from None


def _checked(archive: zipfile.ZipFile, file: Path) -> list[zipfile.ZipInfo]:
    """The entries, if all of them may be extracted."""
    entries = archive.infolist()
    total = 0
    files: set[str] = set()
    folders: set[str] = set()
    for entry in entries:
        # `filename` ends at a zero byte, `orig_filename` does not.
        name = entry.orig_filename
        kind = stat.S_IFMT(entry.external_attr >> 16)
        path = PurePosixPath(name.removesuffix("/"))
        if not _stays_inside(name):
            raise InputError(
                f"{file}: entry {name!r} leaves the folder; nothing was extracted"
            )
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise InputError(
                f"{file}: entry {name!r} is a link or device; only files are allowed"
            )
        if entry.flag_bits & 1:
            raise InputError(
                f"{file}: entry {name!r} is encrypted; give an archive without"
            )
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError(f"{file}: entry {name!r} is neither stored nor deflated")
        if entry.is_dir():
            folders.add(str(path))
        elif str(path) in files:
            raise InputError(f"{file}: entry {name!r} comes twice")
        else:
            files.add(str(path))
        folders.update(map(str, path.parents))
        total += entry.file_size
    if files & folders:
        raise InputError(
            f"{file}: entry {min(files & folders)!r} is a file and a folder"
        )
    _require_at_most(file, total, "archive_bytes", "bytes when extracted")
    ratio = total // max(1, file.stat().st_size)
    _require_at_most(file, ratio, "archive_ratio", "times its own size when extracted")
    return entries


def _stays_inside(name: str) -> bool:
    parts = name.removesuffix("/").split("/")
    if any(part in ("", ".", "..") or len(part.encode()) > 255 for part in parts):
        return False
    # A colon begins a drive or a stream of a file on Windows.
    return set(name).isdisjoint("\\:\0") and len(name) <= 1024


def _extract(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path) -> None:
    left = entry.file_size
    with naming_file(path), archive.open(entry) as source, open(path, "xb") as target:
        while data := source.read(_CHUNK):
            left -= len(data)
            if left < 0:
                raise zipfile.BadZipFile(
                    f"entry {entry.filename!r} is larger than it states"
                )
            target.write(data)
    if left:
        raise zipfile.BadZipFile(f"entry {entry.filename!r} is smaller than it states")
