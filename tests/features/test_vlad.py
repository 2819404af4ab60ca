"""VLAD: the shipped centroids are the shipped encoder's, and the sums are those of a slow twin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import Tensor
from torch.nn import functional as F

from evercal.features import vlad as module
from evercal.features.encoder import LocalEncoder, load_encoder
from evercal.features.vlad import (
    CENTROIDS,
    VLAD_FILE,
    WIDTH,
    Vlad,
    load_centroids,
    save_centroids,
    vlad_for,
)

# Before fixtures of other tests put a quicker one in its place.
FIT = module.fit_centroids


@pytest.fixture
def one_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Centroids come from one room instead of eight, which take seconds to draw."""
    monkeypatch.setattr(module, "fit_centroids", FIT)
    monkeypatch.setattr(module, "_ROOMS", range(8_980, 8_981))


def tiny(seed: int) -> LocalEncoder:
    torch.manual_seed(seed)
    return LocalEncoder(stem=(4, 4), inner=8, blocks=1, width=8).eval()


def features(count: int, width: int, seed: int) -> Tensor:
    drawn = torch.randn(count, width, generator=torch.Generator().manual_seed(seed))
    return F.normalize(drawn, dim=1)


def test_the_shipped_centroids_are_those_of_the_shipped_encoder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    encoder = load_encoder()
    with safe_open(VLAD_FILE, "pt") as file:
        assert file.metadata() == {"encoder": module._digest(encoder)}
        stored = file.get_tensor("centroids")
    assert stored.shape == (CENTROIDS, encoder.width)
    monkeypatch.setattr(module, "fit_centroids", None)  # nothing is fitted for it
    whole = vlad_for(encoder)
    assert torch.equal(whole.centroids, stored.float())
    np.testing.assert_allclose(whole.centroids.norm(dim=1), 1, atol=1e-3)  # half precision
    # They are all different, and none stands for nothing.
    alike = whole.centroids @ whole.centroids.T - 2 * torch.eye(CENTROIDS)
    assert alike.max() < 0.95
    assert whole.projection.shape == (CENTROIDS * encoder.width, WIDTH)
    assert vlad_for(encoder) is whole


@pytest.mark.usefixtures("one_room")
def test_another_encoder_gets_its_own() -> None:
    one, other = vlad_for(tiny(0)), vlad_for(tiny(1))
    for found in (one, other):
        assert found.centroids.shape == (CENTROIDS, 8)
        np.testing.assert_allclose(found.centroids.norm(dim=1), 1, atol=1e-5)
    assert not torch.allclose(one.centroids, other.centroids, atol=1e-2)
    # The same weights give the same, whichever object holds them.
    again = vlad_for(tiny(0))
    assert again is not one
    assert torch.equal(again.centroids, one.centroids)
    assert torch.equal(again.projection, one.projection)
    # A single changed weight of the shipped encoder makes it another one.
    changed = load_encoder()
    assert isinstance(changed, LocalEncoder)
    with torch.no_grad():
        next(changed.parameters()).add_(0.5)
    assert not torch.equal(vlad_for(changed).centroids, vlad_for(load_encoder()).centroids)


@pytest.mark.usefixtures("one_room")
def test_saved_centroids_name_their_encoder(tmp_path: Path) -> None:
    encoder, other = tiny(0), tiny(1)
    save_centroids(encoder, tmp_path / "vlad.safetensors")
    with safe_open(tmp_path / "vlad.safetensors", "pt") as file:
        named = (file.metadata() or {})["encoder"]
        found = file.get_tensor("centroids").float()
    assert named == module._digest(encoder) != module._digest(other)
    torch.testing.assert_close(found, FIT(encoder), atol=1e-3, rtol=0)
    load_centroids(other, tmp_path / "vlad.safetensors")
    assert torch.equal(vlad_for(other).centroids, vlad_for(encoder).centroids)


def test_a_vector_is_the_sum_of_differences_from_the_nearest_centroids() -> None:
    centroids, projection = features(5, 6, 0), torch.randn(30, 12)
    rows = features(40, 6, 1)
    found = Vlad(centroids, projection)(rows)
    sums = np.zeros((5, 6))
    for row in rows.double().numpy():
        nearest = int(np.argmax([row @ c for c in centroids.double().numpy()]))
        sums[nearest] += row - centroids[nearest].double().numpy()
    lengths = np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    whole = (sums / lengths).ravel() @ projection.double().numpy()
    np.testing.assert_allclose(found, whole / np.linalg.norm(whole), atol=1e-5)
    assert float(found.norm()) == pytest.approx(1, abs=1e-5)


def test_order_of_patches_does_not_matter_and_their_kind_does() -> None:
    vlad = vlad_for(load_encoder())
    rows = features(200, vlad.centroids.shape[1], 2)
    shuffled = rows[torch.randperm(200, generator=torch.Generator().manual_seed(3))]
    torch.testing.assert_close(vlad(rows), vlad(shuffled), atol=1e-5, rtol=0)
    # Features that moved a little make more alike a vector than other features.
    near = F.normalize(rows + 0.2 * features(200, rows.shape[1], 5), dim=1)
    far = features(200, vlad.centroids.shape[1], 4)
    assert float(vlad(rows) @ vlad(near)) > float(vlad(rows) @ vlad(far)) + 0.1
