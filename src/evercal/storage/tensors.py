"""Named arrays in safetensors files."""

import errno
import json
import math
import os
import resource
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.bounds import bounds
from evercal.errors import UnavailableError
from evercal.storage.atomic import write_bytes

_LENGTH = 8
"""Bytes of the length of a header, which stands before it."""
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
    from safetensors import SafetensorError
    from safetensors.numpy import load

    with _reading(path):
        try:
            return load(path.read_bytes())
        except SafetensorError as error:
            raise ValueError(error) from None


class _OpenFile:
    """A file that is read by offset, until nobody holds it.

    It is not mapped into memory: where another program truncates a mapped file, the kernel ends
    the process.
    """

    def __init__(self, path: Path):
        self.path = path
        self._descriptor = _descriptor(path)
        weakref.finalize(self, os.close, self._descriptor)
        self._opened = self._state()

    @property
    def size(self) -> int:
        """Bytes of the file when it was opened."""
        return self._opened[0]

    def read(self, start: int, into: NDArray[Any]) -> None:
        """Fill an array with the bytes from an offset on."""
        left = into.reshape(-1).view(np.uint8).data
        while left and (count := os.preadv(self._descriptor, [left], start)):
            start += count
            left = left[count:]
        if left or self._state() != self._opened:
            raise ValueError(
                "it was overwritten in place while it was open; replace a map by 'mv'"
            )

    def _state(self) -> tuple[int, int]:
        status = os.fstat(self._descriptor)
        return status.st_size, status.st_mtime_ns


class StoredRows:
    """The rows of an array in an open file: a slice of them is read when it is asked for."""

    def __init__(self, file: _OpenFile, start: int, kind: str, shape: list[int]):
        self._file = file
        self._start = start
        self._kind = np.dtype(kind)
        self._count, *self._shape = shape

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        start, stop, _ = rows.indices(self._count)
        count = max(stop - start, 0)
        array = np.empty((count, *self._shape), self._kind)
        if array.size:
            row_bytes = array.nbytes // count
            with _reading(self._file.path):
                self._file.read(self._start + start * row_bytes, array)
        return array


def open_tensors(path: Path) -> dict[str, StoredRows]:
    """The named arrays of a file, one or more dimensions each, which stays open."""
    with _reading(path):
        file = _OpenFile(path)
        entries, begin = _header(file)
        arrays = {}
        for name, entry in entries.items():
            if name != "__metadata__":
                arrays[name] = _stored(file, begin, name, entry)
        return arrays


def _header(file: _OpenFile) -> tuple[dict[str, Any], int]:
    """What the header says of each array, and the offset behind it."""
    length = np.zeros(1, "<u8")
    if file.size < _LENGTH:
        raise ValueError("it is too short")
    file.read(0, length)
    count = int(length[0])
    if count > min(bounds().tensor_header_bytes, file.size - _LENGTH):
        raise ValueError(f"its header would have {count} bytes")
    text = np.zeros(count, np.uint8)
    file.read(_LENGTH, text)
    entries = json.loads(text.tobytes())
    if not isinstance(entries, dict):
        raise ValueError("its header is no object")
    return entries, _LENGTH + count


def _stored(file: _OpenFile, begin: int, name: str, entry: Any) -> StoredRows:
    """An array by its entry in the header, whose arrays begin at an offset."""
    try:
        kind = _KINDS[entry["dtype"]]
        shape = list(entry["shape"])
        first, last = entry["data_offsets"]
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"{name!r} in its header is no array") from None
    numbers = [*shape, first, last]
    are_sizes = all(type(n) is int and 0 <= n <= file.size for n in numbers)
    if not shape or not are_sizes or begin + last > file.size:
        raise ValueError(f"{name!r} does not lie in the file")
    if math.prod(shape) * np.dtype(kind).itemsize != last - first:
        raise ValueError(f"{name!r} has not the size of its shape")
    return StoredRows(file, begin + first, kind, shape)


def _descriptor(path: Path) -> int:
    try:
        return os.open(path, os.O_RDONLY)
    except OSError as error:
        if error.errno != errno.EMFILE:
            raise
    # A map has as many files as scenes.
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    return os.open(path, os.O_RDONLY)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, RecursionError) as error:
        raise UnavailableError(
            f"{path}: not readable ({error}); run 'evercal info --check'"
        ) from None
