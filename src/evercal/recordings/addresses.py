"""Folders and files that all machines reach: paths, and addresses of object stores by fsspec."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Self
from uuid import uuid4

from evercal.errors import InputError, optional_module


def is_address(text: object) -> bool:
    """Whether a text such as `s3://bucket/folder` is an address, and not a path."""
    return "://" in str(text)


@dataclass(frozen=True)
class RecordingAt:
    """A recording that is copied where it is learned."""

    address: str
    name: str

    @classmethod
    def of(cls, address: str) -> Self:
        """The recording at an address, with the name of its folder or file."""
        return cls(address, PurePosixPath(address).name)


@contextmanager
def local_copy(address: str) -> Iterator[Path]:
    """A copy of a folder or file on this machine, for a moment.

    Raises:
        InputError: There is nothing, or it cannot be read.
    """
    with tempfile.TemporaryDirectory(prefix="evercal-") as folder:
        with _named(address):
            store, root = _store(address)
            target = Path(folder, PurePosixPath(root).name or "root")
            for file in _files(store, root):
                inside = file.removeprefix(root).strip("/")
                if ".." in inside.split("/"):
                    raise InputError(f"{address}: its file {inside!r} leads out of it; rename it")
                to = target / inside if inside else target
                to.parent.mkdir(parents=True, exist_ok=True)
                store.get_file(file, str(to))
        yield target


def stamps(address: str) -> list[tuple[str, ...]]:
    """Name and version of every file at an address; a file that changes gets another version."""
    with _named(address):
        store, root = _store(address)
        return [(file, str(store.ukey(file))) for file in _files(store, root)]


def exists(address: str) -> bool:
    """Whether there is a file."""
    with _named(address):
        store, path = _store(address)
        return store.exists(path)


def put(file: Path, address: str) -> None:
    """Copy a file to an address: whole, or not at all."""
    with _named(address):
        store, path = _store(address)
        part = f"{path}.{uuid4().hex}.part"
        store.makedirs(path.rpartition("/")[0], exist_ok=True)
        try:
            store.put_file(str(file), part)
            store.mv(part, path)
        finally:
            if store.exists(part):
                store.rm_file(part)


def _store(address: str) -> tuple[Any, str]:
    need = f"{address[:200]}: reading and writing it needs fsspec"
    return optional_module("fsspec.core", need, "ray").url_to_fs(address)


def _files(store: Any, root: str) -> list[str]:
    store.invalidate_cache()  # other machines write, too
    files = sorted(store.find(root))
    if not files:
        raise FileNotFoundError("no such folder or file")
    return files


@contextmanager
def _named(address: str) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # every store raises errors of its own
        raise InputError(f"{address}: {str(error)[:300] or type(error).__name__}") from None
