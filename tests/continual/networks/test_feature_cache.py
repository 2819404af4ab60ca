"""The feature cache: hits, limits, and broken files."""

import os
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from evercal.continual.networks.feature_cache import cache_features


class Counting(nn.Module):
    """Encodes 8x8 means times a weight, and counts the encoded images."""

    stride, width = 8, 2

    def __init__(self, weight: float = 3.0):
        super().__init__()
        self.weight = nn.Parameter(torch.full((2, 1, 8, 8), weight / 64))
        self.captured = 0

    def forward(self, grey: Tensor) -> Tensor:
        self.captured += len(grey)
        return nn.functional.conv2d(grey, self.weight, stride=8)


@torch.inference_mode()
def test_every_image_is_encoded_once(tmp_path: Path, device: torch.device) -> None:
    images = torch.rand(5, 1, 16, 24, generator=torch.Generator().manual_seed(0)).to(device)
    plain, encoder = Counting().to(device), Counting().to(device)
    cache_features(encoder, tmp_path)
    first = encoder(images[:3])
    torch.testing.assert_close(first, plain(images[:3]), atol=1e-3, rtol=0)
    mixed = encoder(images[[4, 1, 0]])  # one new and two cached images
    assert encoder.captured == 4
    assert torch.equal(mixed[1], first[1])
    assert torch.equal(mixed[2], first[0])
    again = Counting().to(device)
    cache_features(again, tmp_path)
    assert torch.equal(again(images[[4, 1, 0]]), mixed)
    assert again.captured == 0
    with torch.autocast(device.type, torch.bfloat16):
        assert torch.equal(again(images[:3]), first)
    assert first.device == device


@torch.inference_mode()
def test_cache_depends_on_weights_and_image_shape(tmp_path: Path) -> None:
    one, two = Counting(1.0), Counting(2.0)
    for encoder in (one, two):
        cache_features(encoder, tmp_path)
    image = torch.ones(1, 1, 16, 16)
    assert float(two(image).mean()) == pytest.approx(2 * float(one(image).mean()), rel=1e-3)
    assert one(image.reshape(1, 1, 8, 32)).shape == (1, 2, 1, 4)
    assert one.captured == 2


@torch.inference_mode()
def test_truncated_file_is_replaced(tmp_path: Path) -> None:
    encoder, image = Counting(), torch.rand(1, 1, 16, 16)
    cache_features(encoder, tmp_path)
    before = encoder(image)
    (file,) = tmp_path.rglob("*.npy")
    file.write_bytes(file.read_bytes()[:-3])
    assert torch.equal(encoder(image), before)
    assert encoder.captured == 2
    assert encoder(image) is not None
    assert encoder.captured == 2


@torch.inference_mode()
def test_full_disk_only_stops_caching(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = torch.rand(4, 1, 16, 16, generator=torch.Generator().manual_seed(1))
    plain, encoder = Counting(), Counting()
    cache_features(encoder, tmp_path)
    encoder(images[:1])
    tries: list[object] = []

    def full(*words: object) -> None:
        tries.append(words)
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        actual = encoder(images)
    torch.testing.assert_close(actual, plain(images), atol=1e-3, rtol=0)
    assert len(tries) == 3
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 1
