"""Folders and files that all machines reach: paths, and addresses of object stores by fsspec."""

import hashlib
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, Self
from uuid import uuid4

from evercal.bounds import bounds, require_at_most
from evercal.classes import frozen
from evercal.errors import InputError, optional_module, without_secrets
from evercal.storage.text_files import library_errors
from evercal.typing import Strings

Check = Callable[[Path], object]
_TEXTS = (".csv", ".json", ".txt", ".urdf", ".yaml", ".yml")
"""Endings of files by which recordings are recognised."""
_READ = {"atime", "time"}
"""Times of reading, as SFTP states them."""


def is_address(text: object) -> bool:
    """Whether a text such as `s3://bucket/folder` is an address, and not a path."""
    return "://" in str(text)


@frozen
class RecordingAt:
    """A recording that is copied where it is learned."""

    address: str
    name: str

    @classmethod
    def of(cls, address: str) -> Self:
        """The recording at an address, with the name of its folder or file."""
        return cls(address, PurePosixPath(without_secrets(address)).name)


@contextmanager
def local_copy(address: str, check: Check = Path) -> Iterator[Path]:
    """A copy of a folder or file on this machine, for a moment.

    `check` refuses a copy in which all but small texts are still empty.

    Raises:
        InputError: There is nothing, it is too large, or it cannot be read.
    """
    with tempfile.TemporaryDirectory(prefix="evercal-") as folder:
        target = Path(folder)
        try:
            with _store(address) as (store, root):
                target /= PurePosixPath(root).name or "root"
                _copy(store, root, target, check)
            yield target
        except InputError as error:
            raise InputError(str(error).replace(str(target), address)) from None


def _copy(store: Any, root: str, target: Path, check: Check) -> None:
    sizes = _files(store, root)
    copies = {file: target / file.removeprefix(root).strip("/") for file in sizes}
    texts = []  # the copy is the target itself where the address is a file
    for file, copy in copies.items():
        if ".." in copy.parts:
            raise ValueError(f"its file {file!r} leads out of it; rename it")
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.touch()
        if _is_text(file, sizes[file]):
            texts.append(file)
    for files in (texts, copies.keys() - texts):
        for file in files:
            store.get_file(file, str(copies[file]))
            if copies[file].stat().st_size < sizes[file]:
                raise ValueError(f"{file} ended early; try again")
        check(target)


def _is_text(file: str, size: int) -> bool:
    return file.endswith(_TEXTS) and size <= bounds().text_bytes


def stamps(address: str) -> list[Strings]:
    """Name and version of every file at an address; a file that changes gets another version.

    fsspec's own `ukey` is that of the address over HTTP, and another one in each process for zip.
    """
    with _store(address) as (store, root):
        stamped = []
        for file, size in _files(store, root).items():
            info = store.info(file)
            version = [f"{key}={info[key]}" for key in sorted(info.keys() - _READ)]
            if _is_text(file, size):  # times may be whole seconds
                version.append(hashlib.sha256(store.cat_file(file)).hexdigest())
            stamped.append((file, *version))
        return stamped


def exists(address: str) -> bool:
    """Whether there is a file; an InputError if nobody answers."""
    with _store(address) as (store, path):
        try:
            store.info(path)
        except FileNotFoundError:
            return False
        return True


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
    fsspec = optional_module("fsspec", need, "ray")
    if address.rstrip("/").endswith(":"):
        raise InputError(f"{address}: names no folder, as in s3://bucket/room")
    with library_errors(f"{address}: cannot be read or written"):
        try:
            yield fsspec.url_to_fs(address)
        except FileNotFoundError:
            raise InputError(
                f"{address}: no such folder or file, or no answer"
            ) from None
        except Exception:
            for kind in fsspec.registry.values():
                kind.clear_instance_cache()  # else the next try has the same connection
            raise


def _files(store: Any, root: str) -> dict[str, int]:
    """Names of all files, sorted, and their sizes, as far as the store states them."""
    store.invalidate_cache()  # other machines write, too
    top = store.info(root)
    sizes = {root: top["size"] or 0}
    folders = []
    if top["type"] == "directory" or store.isdir(root):
        sizes = {}
        folders = [root]
    # fsspec's own `walk` and `find` leave out folders that cannot be listed.
    for folder in folders:
        for info in store.ls(folder, detail=True):
            if info["name"].strip("/") == folder.strip("/"):
                continue
            if info["type"] == "directory":
                folders.append(info["name"])
            else:
                sizes[info["name"]] = info["size"] or 0
        require_at_most(
            len(folders) + len(sizes), "recording_files", "files at an address"
        )
    require_at_most(sum(sizes.values()), "recording_bytes", "bytes at an address")
    if not sizes:
        raise FileNotFoundError(root)
    return dict(sorted(sizes.items()))
