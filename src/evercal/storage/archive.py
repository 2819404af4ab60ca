"""Zip archives of folders: written as one file, and extracted without trust in their content."""

import contextlib
import errno
import shutil
import stat
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from evercal.errors import InputError
from evercal.storage.atomic import replacing
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


@dataclass(frozen=True)
class ArchiveLimits:
    """What an archive may contain."""

    bytes: int = 20 * 10**9
    """Size of all extracted files."""
    files: int = 200_000
    """Number of entries."""


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


def check_archive(file: Path, limits: ArchiveLimits = ArchiveLimits()) -> list[str]:
    """Check the entries of a zip archive without extracting them.

    Returns:
        The paths of its files.
    """
    with _opened(file, limits) as archive:
        return [e.filename for e in _checked(archive, file, limits) if not e.is_dir()]


def extract_archive(
    file: Path, folder: Path, limits: ArchiveLimits = ArchiveLimits()
) -> None:
    """Extract a zip archive into a folder that does not exist yet.

    Sizes are checked twice: as the archive states them, and while the files are written.
    """
    folder.mkdir(parents=True)
    with _opened(file, limits) as archive:
        for entry in _checked(archive, file, limits):
            path = folder / entry.filename
            if entry.is_dir():
                path.mkdir(parents=True, exist_ok=True)
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            _extract(archive, entry, path)


@contextlib.contextmanager
def _opened(file: Path, limits: ArchiveLimits) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(_bounded(file, limits)) as archive:
            yield archive
    except (*_BROKEN, OSError) as error:
        # A broken offset is an invalid argument of a system call.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise
        raise InputError(f"{file}: not a readable zip archive ({error})") from None


def _bounded(file: Path, limits: ArchiveLimits) -> Path:
    with open(file, "rb") as opened:
        # The library's own search, so that both find the same directory.
        end = zipfile._EndRecData(opened)  # pyright: ignore[reportAttributeAccessIssue]
    if not end:
        raise InputError(f"{file}: not a zip archive")
    entries, directory_bytes = end[4:6]
    if max(entries, directory_bytes // _DIRECTORY_BYTES) > limits.files:
        raise InputError(f"{file}: more than {limits.files:,} entries; split it")
    return file


def _checked(
    archive: zipfile.ZipFile, file: Path, limits: ArchiveLimits
) -> list[zipfile.ZipInfo]:
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
    if total > limits.bytes:
        raise InputError(
            f"{file}: {total / 1e9:.1f} GB when extracted; at most {limits.bytes / 1e9:.1f} GB"
        )
    return entries


def _stays_inside(name: str) -> bool:
    parts = name.removesuffix("/").split("/")
    if any(part in ("", ".", "..") or len(part.encode()) > 255 for part in parts):
        return False
    has_drive = parts[0][1:2] == ":"
    return not has_drive and set(name).isdisjoint("\\\0") and len(name) <= 1024


def _extract(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path) -> None:
    left = entry.file_size
    with archive.open(entry) as source, open(path, "xb") as target:
        while data := source.read(_CHUNK):
            left -= len(data)
            if left < 0:
                raise zipfile.BadZipFile(
                    f"entry {entry.filename!r} is larger than it states"
                )
            target.write(data)
    if left:
        raise zipfile.BadZipFile(f"entry {entry.filename!r} is smaller than it states")
