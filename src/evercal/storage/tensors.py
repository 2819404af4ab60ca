"""Named arrays in safetensors files."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.storage.atomic import write_bytes


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


class StoredRows:
    """The rows of an array in a mapped file: a slice of them is copied.

    Unlike those of the library, slices may be empty everywhere.
    """

    def __init__(self, file: Any, name: str):
        self._rows = file.get_slice(name)
        shape = self._rows.get_shape()
        self._count = shape[0]
        if 0 in shape:
            self._rows = file.get_tensor(name)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        start, stop, _ = rows.indices(self._count)
        if start >= stop:
            return self._rows[:0]
        return self._rows[start:stop]


def open_tensors(path: Path) -> dict[str, StoredRows]:
    """The named arrays of a file, one or more dimensions each, which stays mapped into memory."""
    from safetensors import safe_open

    with _reading(path):
        file = safe_open(path, "np")
        return {name: StoredRows(file, name) for name in file.keys()}  # noqa: SIM118


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    from safetensors import SafetensorError

    try:
        yield
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"{path}: not readable ({error}); run 'evercal info --check'"
        ) from None
