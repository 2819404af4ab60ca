"""Named arrays in safetensors files."""

import errno
import io
import json
import os
import sys
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.bounds import bounds
from evercal.errors import UnavailableError
from evercal.storage.atomic import write_bytes

_LENGTH = 8
"""Bytes of the length of a header, which stands before it."""
_MOST_FILES_MACOS = 10_240
"""OPEN_MAX of macOS, which refuses a higher limit even where it states none."""
_KINDS = {
    "BOOL": "?",
    "U8": "u1",
    "I8": "i1",
    "U16": "<u2",
    "I16": "<i2",
    "F16": "<f2",
    "U32": "<u4",
    "I32": "<i4",
    "F32": "<f4",
    "U64": "<u8",
    "I64": "<i8",
    "F64": "<f8",
}
"""Types of numbers by their names in a header."""


def save_tensors(
    path: Path,
    arrays: Mapping[str, NDArray[np.generic]],
    metadata: dict[str, str] | None = None,
) -> None:
    """Write named arrays, whole or not at all."""
    from safetensors.numpy import save

    # The writer stores the memory of an array as it lies, also of a transposed one.
    plain = {name: np.asarray(value, order="C") for name, value in arrays.items()}
    write_bytes(path, save(plain, metadata))


def load_tensors(path: Path) -> dict[str, NDArray[np.generic]]:
    """Read the named arrays of a file."""
    from safetensors.numpy import load

    with _reading(path):
        return load(path.read_bytes())


class _OpenFile:
    """A file that is read by offset, until nobody holds it.

    It is not mapped into memory: where another program truncates a mapped file, the kernel ends
    the process.
    """

    def __init__(self, path: Path):
        self.path = path
        self._file = _opened(path)
        weakref.finalize(self, self._file.close)
        self._lock = Lock()
        self._opened = self._state()
        self.bytes, _ = self._opened

    def read(self, start: int, array: NDArray[Any]) -> NDArray[Any]:
        """Fill an array with the bytes from an offset on."""
        with self._lock:
            self._file.seek(start)
            count = self._file.readinto(array.data)
        if count != array.nbytes or self._state() != self._opened:
            raise ValueError(
                "it is too short, or was overwritten in place while it was open; replace a map by"
                " 'mv'"
            )
        return array

    def _state(self) -> tuple[int, int]:
        status = os.fstat(self._file.fileno())
        return status.st_size, status.st_mtime_ns


class StoredRows:
    """The rows of an array in an open file: a slice of them is read when it is asked for."""

    def __init__(self, file: _OpenFile, start: int, like: NDArray[Any]):
        self._file = file
        self._start = start
        self._row_bytes = like[:1].nbytes
        self._like = like
        self.dtype = like.dtype
        self.shape = like.shape

    def __len__(self) -> int:
        return len(self._like)

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        part = self._like[rows]
        first, _, _ = rows.indices(len(self._like))
        array = np.empty(part.shape, part.dtype)
        try:
            return self._file.read(self._start + first * self._row_bytes, array)
        except (OSError, ValueError) as error:
            raise _unreadable(self._file.path, error) from None


def open_tensors(path: Path) -> dict[str, StoredRows]:
    """The named arrays of a file, one or more dimensions each, which stays open."""
    with _reading(path):
        file = _OpenFile(path)
        count = int.from_bytes(file.read(0, np.empty(_LENGTH, np.uint8)), "little")
        if count > bounds().tensor_header_bytes:
            raise ValueError(f"its header would have {count} bytes")
        text = file.read(_LENGTH, np.empty(count, np.uint8))
        header = json.loads(text.tobytes())
        header.pop("__metadata__", None)
        start = _LENGTH + count
        arrays = {}
        for name, entry in header.items():
            first, last = entry["data_offsets"]
            # An array that takes no memory, of this type and shape.
            like = np.broadcast_to(np.zeros((), _KINDS[entry["dtype"]]), entry["shape"])
            if not like.ndim or len(range(first, last)) != like.nbytes:
                raise ValueError(f"{name!r} has not the size of its shape")
            if first < 0 or start + last > file.bytes:
                raise ValueError(f"{name!r} does not lie in the file")
            arrays[name] = StoredRows(file, start + first, like)
        return arrays


def _opened(path: Path) -> io.FileIO:
    try:
        return path.open("rb", buffering=0)
    except OSError as error:
        if error.errno != errno.EMFILE:
            raise
    _open_more_files()
    return path.open("rb", buffering=0)


def _open_more_files() -> None:
    """Raise the limit of open files: a map has as many as scenes. Windows opens 8,192 anyway."""
    if sys.platform == "win32":
        return
    import resource

    kind = resource.RLIMIT_NOFILE
    _, most = resource.getrlimit(kind)
    if sys.platform == "darwin":
        most = min(most, _MOST_FILES_MACOS)
    resource.setrlimit(kind, (most, most))


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # nothing is assumed about a header
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> UnavailableError:
    return UnavailableError(
        f"{path}: not readable ({error}); run 'evercal info --check'"
    )
