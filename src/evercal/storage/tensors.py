"""Named arrays in safetensors files."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.storage.atomic import write_bytes


def save_tensors(
    path: Path, arrays: Mapping[str, NDArray[np.generic]], metadata: dict[str, str] | None = None
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

    try:
        return load(path.read_bytes())
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: not readable ({error}); run 'evercal info --check'") from None


def open_tensors(path: Path) -> dict[str, Any]:
    """The named arrays of a file that stays mapped into memory: slices of them are copied."""
    from safetensors import SafetensorError, safe_open

    try:
        file = safe_open(path, "np")
        return {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: not readable ({error}); run 'evercal info --check'") from None
