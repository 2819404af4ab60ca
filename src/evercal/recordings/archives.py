"""Archives of a recording that were downloaded and not unpacked."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evercal.errors import InputError
from evercal.storage.text_files import few, natural_key

_ENDINGS = {".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar"}
"""Endings of archives."""


@contextmanager
def naming_archives(path: Path) -> Iterator[None]:
    """Name archives at a path in the `InputError` of a recording that cannot be read.

    They are those in the folder, that of a missing folder, or the path itself. An archive beside a
    file or folder of its name is unpacked.
    """
    try:
        yield
    except InputError as error:
        folder = next(place for place in (path, *path.parents) if place.is_dir())
        archives = []
        for file in folder.iterdir():
            content = folder / file.name.partition(".")[0]
            if file.suffix.lower() not in _ENDINGS or content.exists():
                continue
            if folder == path or path in (file, content) or content in path.parents:
                archives.append(file.name)
        if not archives:
            raise
        names = few(sorted(archives, key=natural_key))
        text = f"{error}; not unpacked: {names}; unpack in {folder}"
        raise InputError(text) from None
