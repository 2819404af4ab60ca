"""A cache of encoded images on disk, for runs that encode the same views repeatedly."""

import contextlib
import hashlib
import os
import uuid
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn


def cache_features(encoder: nn.Module, folder: Path) -> None:
    """Make a frozen encoder read and write its features in a folder.

    Features get half precision, cached or not, so results do not depend on the cache. The folder
    may be deleted at any time. The encoder is changed in place.
    """
    weights = hashlib.blake2b(digest_size=8)
    for value in encoder.state_dict().values():
        weights.update(value.detach().cpu().float().numpy().tobytes())
    folder = folder / weights.hexdigest()
    folder.mkdir(parents=True, exist_ok=True)
    compute = encoder.forward

    def forward(grey: Tensor) -> Tensor:
        paths = [folder / _name(image) for image in grey]
        features = [read_cached(path) for path in paths]
        missing = [i for i, value in enumerate(features) if value is None]
        if missing:
            for i, value in zip(missing, compute(grey[missing]).half().cpu(), strict=True):
                features[i] = value
                write_cached(paths[i], value)
        return torch.stack([value.float() for value in features if value is not None]).to(
            grey.device
        )

    encoder.forward = forward


def _name(image: Tensor) -> str:
    shape = "x".join(map(str, image.shape))
    digest = hashlib.blake2b(image.cpu().numpy().tobytes(), digest_size=16).hexdigest()
    # Rounding depends on the kind of device, so features of different kinds are kept apart.
    kind = "" if image.device.type == "cpu" else f"-{image.device.type}"
    return f"{shape}-{digest}{kind}.npy"


def read_cached(path: Path) -> Tensor | None:
    """Read a tensor; None if it is missing or damaged."""
    try:
        return torch.from_numpy(np.load(path))
    except (OSError, ValueError, EOFError):
        return None


def write_cached(path: Path, features: Tensor) -> None:
    """Write a tensor, unless the disk is full.

    It is not synced, because what a power failure loses is computed again.
    """
    temporary = path.with_name(f".{uuid.uuid4().hex[:8]}.npy")
    with contextlib.suppress(OSError):  # usually a full disk
        try:
            np.save(temporary, features.contiguous().numpy())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
