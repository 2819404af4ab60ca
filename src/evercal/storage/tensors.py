"""Named tensors in safetensors files."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from evercal.errors import InputError
from evercal.storage.atomic import write_bytes

if TYPE_CHECKING:
    from torch import Tensor


def save_tensors(
    path: Path, tensors: "Mapping[str, Tensor]", metadata: dict[str, str] | None = None
) -> None:
    """Write named tensors, whole or not at all."""
    from safetensors.torch import save

    plain = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    write_bytes(path, save(plain, metadata))


def load_tensors(path: Path) -> "dict[str, Tensor]":
    """Read the named tensors of a file."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        return load(path.read_bytes())
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: not readable ({error}); run 'evercal info --check'") from None
