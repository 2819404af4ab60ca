"""Encoders for tests: the mean of each cell, and small random networks."""

import tempfile
from pathlib import Path

import numpy as np
import pytest

from evercal.features.encoder import Encoder, load_encoder
from evercal.typing import Float32Array, Image

STEM = (4, 3, 1), (4, 3, 1), (4, 2, 2), (4, 3, 1), (8, 2, 2)
TINY = 2, STEM, (3, 1, 3), 1, 8
"""`training.network.Layout` of a small network with eight channels."""


class BlockMean(Encoder):
    """One channel: the mean grey value of each cell, in [0, 1]."""

    def __init__(self) -> None:
        self.name = "block_mean"
        self.data = b""
        self.fingerprint = []
        self.stride = 8
        self.width = 1

    def __call__(self, grey: Image) -> Float32Array:
        rows, columns = (side // 8 for side in grey.shape)
        blocks = grey[: 8 * rows, : 8 * columns].reshape(rows, 8, columns, 8)
        return blocks.mean((1, 3), dtype=np.float32)[..., None] / 255


def tiny_onnx(seed: int = 0) -> bytes:
    """An ONNX file of a small network with random weights."""
    torch = pytest.importorskip("torch", reason="the extra 'networks' is not installed")
    pytest.importorskip("onnx", reason="onnx is not installed")
    from training.network import Layout, LocalEncoder, onnx_bytes

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return onnx_bytes(LocalEncoder(Layout(*TINY)))


def tiny_encoder(seed: int = 0) -> Encoder:
    """The encoder of `tiny_onnx`."""
    with tempfile.NamedTemporaryFile(suffix=".onnx") as file:
        file.write(tiny_onnx(seed))
        file.flush()
        return load_encoder(Path(file.name))
