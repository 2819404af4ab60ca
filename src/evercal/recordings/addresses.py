"""Folders and files that all machines reach: paths, and addresses of object stores by fsspec."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Self
from uuid import uuid4

from evercal.errors import InputError, optional_module
from evercal.storage.text_files import library_errors


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
        with _store(address) as (store, root):
            target = Path(folder, PurePosixPath(root).name or "root")
            for file in _files(store, root, address):
                inside = file.removeprefix(root).strip("/")
                if ".." in inside.split("/"):
                    raise InputError(
                        f"{address}: its file {inside!r} leads out of it; rename it"
                    )
                copy = target / inside  # target itself where the address is a file
                copy.parent.mkdir(parents=True, exist_ok=True)
                store.get_file(file, str(copy))
        yield target


def stamps(address: str) -> list[tuple[str, ...]]:
    """Name and version of every file at an address; a file that changes gets another version."""
    with _store(address) as (store, root):
        return [(file, str(store.ukey(file))) for file in _files(store, root, address)]


def exists(address: str) -> bool:
    """Whether there is a file."""
    with _store(address) as (store, path):
        return store.exists(path)


def put(file: Path, address: str) -> None:
    """Copy a file to an address: whole, or not at all."""
    with _store(address) as (store, path):
        part = f"{path}.{uuid4().hex}.part"
        store.makedirs(path.rpartition("/")[0], exist_ok=True)
        try:
            store.put_file(str(file), part)
            store.mv(part, path)
        finally:
            if store.exists(part):
                store.rm_file(part)


@contextmanager
def _store(address: str) -> Iterator[tuple[Any, str]]:
    """The file system of an address, and the path in it; its errors name the address."""
    need = f"{address[:200]}: reading and writing it needs fsspec"
    fsspec = optional_module("fsspec.core", need, "ray")
    with library_errors(f"{address}: cannot be read or written"):
        yield fsspec.url_to_fs(address)


def _files(store: Any, root: str, address: str) -> list[str]:
    store.invalidate_cache()  # other machines write, too
    files = sorted(store.find(root))
    if not files:
        raise InputError(f"{address}: no such folder or file")
    return files
