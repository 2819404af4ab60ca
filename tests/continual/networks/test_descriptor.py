"""The global descriptor and its file."""

from pathlib import Path

import numpy as np
import pytest
import torch

from evercal.continual.networks.descriptor import (
    DESCRIBED_ENCODER,
    GlobalDescriptor,
    described,
    descriptor_bytes,
    load_descriptor,
)
from evercal.errors import InputError
from evercal.features.encoder import load_encoder

from ..draws import seeded


def tiny() -> GlobalDescriptor:
    torch.manual_seed(0)
    return GlobalDescriptor(5, maps=3, hidden=4, width=6)


def by_hand(descriptor: GlobalDescriptor, features: np.ndarray) -> np.ndarray:
    """Map one image's (inputs, cells) features to (width,), cell by cell in double precision."""
    w = {
        k: v.double().squeeze(-1).squeeze(-1).numpy()
        for k, v in descriptor.state_dict().items()
    }
    weights = []
    values = []
    for cell in features.T:
        lifted = np.maximum(w["lift.weight"] @ cell + w["lift.bias"], 0)
        weights.append(np.exp(w["attention.weight"] @ lifted + w["attention.bias"]))
        values.append(w["value.weight"] @ lifted + w["value.bias"])
    share = np.array(weights) / np.sum(weights, axis=0)
    pooled = share.T @ np.array(values)
    pooled /= np.linalg.norm(pooled, axis=1, keepdims=True)
    projection = descriptor.project.weight.detach().double().numpy()
    whole = (
        projection @ pooled.ravel() + descriptor.project.bias.detach().double().numpy()
    )
    return whole / np.linalg.norm(whole)


def test_output_matches_a_slow_reference() -> None:
    descriptor = tiny()
    features = torch.randn(2, 5, 3, 4, generator=seeded(1))
    with torch.no_grad():
        actual = descriptor(features)
    for vector, image in zip(actual, features, strict=True):
        twin = by_hand(descriptor, image.flatten(1).double().numpy())
        np.testing.assert_allclose(vector.numpy(), twin, atol=1e-5)


def test_round_trip_through_a_file(tmp_path: Path) -> None:
    descriptor = tiny()
    path = tmp_path / "descriptor.safetensors"
    path.write_bytes(descriptor_bytes(descriptor))
    actual = load_descriptor(path)
    assert actual.settings == descriptor.settings
    for key, value in descriptor.state_dict().items():
        assert torch.equal(actual.state_dict()[key], value.half().float())


def test_broken_files_are_refused(tmp_path: Path) -> None:
    from safetensors.torch import save

    good = descriptor_bytes(tiny())
    broken = {
        "cut": good[: len(good) // 2],
        "other_kind": save({"a": torch.zeros(1)}, {"encoder": '{"inputs": 5}'}),
        "strange_settings": save({"a": torch.zeros(1)}, {"descriptor": '{"depth": 3}'}),
        "other_tensors": save({"a": torch.zeros(1)}, {"descriptor": '{"inputs": 5}'}),
    }
    for name, data in broken.items():
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(data)
        with pytest.raises(InputError, match="not an evercal descriptor") as caught:
            load_descriptor(path)
        assert str(path) in str(caught.value)
        assert len(str(caught.value).splitlines()) == 1
    with pytest.raises(InputError, match="no such file"):
        load_descriptor(tmp_path / "none.safetensors")


def test_shipped_descriptor_fits_the_shipped_encoder() -> None:
    descriptor = load_descriptor()
    grey = np.random.default_rng(0).integers(0, 256, (64, 80)).astype(np.uint8)
    rows, vector = described(load_encoder(DESCRIBED_ENCODER)(grey), descriptor)
    assert rows.shape == (80, descriptor.settings["inputs"])
    assert vector.shape == (descriptor.width,)
    assert float(vector.norm()) == pytest.approx(1.0, abs=1e-5)
