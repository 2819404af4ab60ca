"""The feature cache: hits, limits, and broken files."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from evercal.continual.networks.descriptor import PooledDescriptor
from evercal.continual.networks.feature_cache import cache_features, row_encoder
from evercal.features.encoder import Encoder
from evercal.typing import Float32Array

IMAGES = np.random.default_rng(0).integers(0, 256, (5, 16, 24)).astype(np.uint8)


class Counting:
    """The eight rows of each cell added up, times a weight; counts the encoded images."""

    def __init__(self, weight: float = 3.0):
        self.weight = weight
        self.captured = 0

    def __call__(self, grey: Float32Array) -> Float32Array:
        self.captured += 1
        rows, columns = (side // 8 for side in grey.shape)
        return self.weight * grey.reshape(rows, 8, columns, 8).sum(1) + self.weight**2


def made(weight: float = 3.0, folder: Path | None = None) -> tuple[Encoder, Counting]:
    counting = Counting(weight)
    encoder = Encoder(counting, "counting")
    counting.captured = 0
    if folder is not None:
        cache_features(encoder, folder)
    return encoder, counting


def test_every_image_is_encoded_once(tmp_path: Path) -> None:
    plain, _ = made()
    encoder, counting = made(folder=tmp_path)
    first = [encoder(image) for image in IMAGES[:3]]
    np.testing.assert_allclose(first, [plain(image) for image in IMAGES[:3]], atol=1e-3)
    mixed = [encoder(IMAGES[i]) for i in (4, 1, 0)]  # one new and two cached images
    assert counting.captured == 4
    np.testing.assert_array_equal(mixed[1:], first[1::-1])
    again, counting = made(folder=tmp_path)
    np.testing.assert_array_equal([again(IMAGES[i]) for i in (4, 1, 0)], mixed)
    assert counting.captured == 0
    assert mixed[0].dtype == np.float32


def test_cache_depends_on_encoder_and_image_shape(tmp_path: Path) -> None:
    one, counting = made(1.0, tmp_path)
    two, other = made(2.0, tmp_path)
    assert np.abs(one(IMAGES[0]) - two(IMAGES[0])).max() > 0.01
    assert one(IMAGES[0].reshape(8, 48)).shape == (1, 6, 8)
    assert (counting.captured, other.captured) == (2, 1)


def test_truncated_file_is_replaced(tmp_path: Path) -> None:
    encoder, counting = made(folder=tmp_path)
    before = encoder(IMAGES[0])
    (file,) = tmp_path.rglob("*.npy")
    file.write_bytes(file.read_bytes()[:-3])
    for _ in range(2):
        np.testing.assert_array_equal(encoder(IMAGES[0]), before)
        assert counting.captured == 2


def test_full_disk_only_stops_caching(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, _ = made()
    encoder, _ = made(folder=tmp_path)
    encoder(IMAGES[0])
    tries: list[object] = []

    def full(*words: object) -> None:
        tries.append(words)
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        actual = [encoder(image) for image in IMAGES[:4]]
    np.testing.assert_allclose(
        actual, [plain(image) for image in IMAGES[:4]], atol=1e-3
    )
    assert len(tries) == 3
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 1


def test_kept_rows_are_encoded_once_and_others_take_no_space(tmp_path: Path) -> None:
    encoder, counting = made()
    descriptor = PooledDescriptor(encoder.width, 5)
    keep = np.array([True, False, False, True, True, False])
    plain = row_encoder(encoder, descriptor)
    expected = [plain(image, keep) for image in IMAGES]
    features, vector = expected[0]
    assert (features.shape, features.dtype) == ((3, 8), torch.half)
    torch.testing.assert_close(
        features.float(),
        torch.from_numpy(encoder(IMAGES[0])).flatten(0, 1)[keep],
        rtol=0,
        atol=1e-3,
    )
    counting.captured = 0
    cached = row_encoder(encoder, descriptor, tmp_path)
    for _ in range(2):
        for image, (features, vector) in zip(IMAGES, expected, strict=True):
            again = cached(image, keep)
            assert torch.equal(again[0], features)
            assert torch.equal(again[1], vector)
    assert counting.captured == len(IMAGES)
    sizes = [path.stat().st_size for path in tmp_path.rglob("*.npy")]
    assert len(sizes) == len(IMAGES)
    assert max(sizes) == 128 + 2 * 3 * 8 + 4 * 5  # a header of NumPy, halves, singles
    # Other cells, another descriptor and another encoder have rows of their own.
    cached(IMAGES[0], ~keep)
    row_encoder(encoder, PooledDescriptor(encoder.width, 6), tmp_path)(IMAGES[0], keep)
    assert counting.captured == len(IMAGES) + 2
    other, others = made(1.0)
    row_encoder(other, descriptor, tmp_path)(IMAGES[0], keep)
    assert others.captured == 1


def test_a_damaged_file_of_rows_is_replaced(tmp_path: Path) -> None:
    encoder, counting = made()
    cached = row_encoder(encoder, PooledDescriptor(encoder.width, 5), tmp_path)
    keep = np.ones(6, bool)
    before = cached(IMAGES[0], keep)
    (file,) = tmp_path.rglob("*.npy")
    file.write_bytes(file.read_bytes()[:-3])
    again = cached(IMAGES[0], keep)
    assert all(torch.equal(*pair) for pair in zip(before, again, strict=True))
    assert counting.captured == 2
