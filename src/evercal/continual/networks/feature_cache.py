"""A cache of encoded images on disk, for runs that encode the same views repeatedly."""

import contextlib
import hashlib
import os
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evercal.continual.networks.descriptor import (
    Descriptor,
    described,
    descriptor_bytes,
)
from evercal.features.encoder import Encoder
from evercal.typing import Array, BoolArray, Float32Array, Image

RowEncoder = Callable[[Image, BoolArray], tuple[Tensor, Tensor]]
"""Makes features (rows, channels) of the cells of an image that a mask (cells,) keeps, in half
precision, and the descriptor (width,) of the image; both on the CPU."""


def row_encoder(
    encoder: Encoder, descriptor: Descriptor, cache: Path | None = None
) -> RowEncoder:
    """Encode rows of images, or read those that are in a folder."""

    def encoded(grey: Image, keep: BoolArray) -> tuple[Tensor, Tensor]:
        features, vector = described(encoder(grey), descriptor)
        return features.cpu()[torch.from_numpy(keep)].half(), vector.cpu()

    if not cache:
        return encoded
    key = hashlib.blake2b(descriptor_bytes(descriptor), digest_size=4)
    folder = cache / f"{encoder_key(encoder)}-{key.hexdigest()}"

    def read(grey: Image, keep: BoolArray) -> tuple[Tensor, Tensor]:
        def computed() -> NDArray[Any]:
            features, vector = encoded(grey, keep)
            # The descriptor keeps its single precision: two halves a channel.
            halves = vector.numpy().view(np.float16)
            return np.concatenate([features.numpy().ravel(), halves])

        key = hashlib.blake2b(grey.tobytes() + keep.tobytes(), digest_size=16)
        stored = cached(folder / f"{key.hexdigest()}.npy", computed)
        count = int(keep.sum()) * encoder.width
        features, halves = np.split(stored, [count])
        features = torch.from_numpy(features.reshape(-1, encoder.width))
        return features, torch.from_numpy(halves.view(np.float32))

    return read


def cache_features(encoder: Encoder, folder: Path) -> None:
    """Make an encoder read and write its features in a folder.

    Features get half precision, cached or not, so results do not depend on the cache. The folder
    may be deleted at any time. The encoder is changed in place.
    """
    folder = folder / encoder_key(encoder)
    compute = encoder.function

    def read(grey: Float32Array) -> Array:
        digest = hashlib.blake2b(grey.tobytes(), digest_size=16).hexdigest()
        path = folder / f"{'x'.join(map(str, grey.shape))}-{digest}.npy"
        features = cached(path, lambda: np.asarray(compute(grey), np.float16))
        return features.astype(np.float32)

    encoder.function = read


def encoder_key(encoder: Encoder) -> str:
    """Name of an encoder that another one does not have."""
    made = encoder.data or f"{encoder.name} {encoder.fingerprint}".encode()
    return hashlib.blake2b(made, digest_size=8).hexdigest()


def cached(path: Path, compute: Callable[[], NDArray[Any]]) -> NDArray[Any]:
    """Read an array. If it is missing or damaged, compute it, and write it unless the disk is full.

    It is not synced, because what a power failure loses is computed again.
    """
    with contextlib.suppress(OSError, ValueError, EOFError):
        return np.load(path)
    values = compute()
    temporary = path.with_name(f".{uuid.uuid4().hex[:8]}.npy")
    with contextlib.suppress(OSError):  # usually a full disk
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            np.save(temporary, values)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    return values
