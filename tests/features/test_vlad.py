"""VLAD: shipped and fitted centroids, and sums against a slow twin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import Tensor
from torch.nn import functional as F

from evercal.errors import InputError
from evercal.features import vlad as module
from evercal.features.encoder import LocalEncoder, load_encoder
from evercal.features.vlad import (
    CENTROIDS,
    VLAD_FILE,
    WIDTH,
    Vlad,
    fit_centroids,
    load_centroids,
    save_centroids,
    vlad_for,
)


def tiny(seed: int) -> LocalEncoder:
    torch.manual_seed(seed)
    return LocalEncoder(stem=(4, 4), inner=8, blocks=1, width=8).eval()


def features(count: int, width: int, seed: int) -> Tensor:
    drawn = torch.randn(count, width, generator=torch.Generator().manual_seed(seed))
    return F.normalize(drawn, dim=1)


def test_shipped_centroids_are_those_of_the_shipped_encoder() -> None:
    encoder = load_encoder()
    with safe_open(VLAD_FILE, "pt") as file:
        assert file.metadata() == {"encoder": module._digest(encoder)}
        stored = file.get_tensor("centroids")
    assert stored.shape == (CENTROIDS, encoder.width)
    vlad = vlad_for(encoder)
    assert torch.equal(vlad.centroids, stored.float())
    np.testing.assert_allclose(vlad.centroids.norm(dim=1), 1, atol=1e-3)  # half precision
    # They are all different.
    similarity = vlad.centroids @ vlad.centroids.T - 2 * torch.eye(CENTROIDS)
    assert similarity.max() < 0.95
    assert vlad.projection.shape == (CENTROIDS * encoder.width, WIDTH)
    assert vlad_for(encoder) is vlad


def test_another_encoder_has_centroids_of_given_features() -> None:
    with pytest.raises(InputError, match="no VLAD centroids; learn a recording"):
        vlad_for(tiny(0))
    images = [features(50, 8, seed) for seed in range(4)]
    encoder, other = tiny(0), tiny(1)
    one, two = vlad_for(encoder, images), vlad_for(other, [-image for image in images])
    for vlad in (one, two):
        assert vlad.centroids.shape == (CENTROIDS, 8)
        np.testing.assert_allclose(vlad.centroids.norm(dim=1), 1, atol=1e-5)
    assert not torch.allclose(one.centroids, two.centroids, atol=1e-2)
    # They are fitted once.
    assert vlad_for(encoder) is vlad_for(encoder, images[:1]) is one
    # The fit is deterministic.
    again = vlad_for(tiny(0), images)
    assert torch.equal(again.centroids, one.centroids)
    assert torch.equal(again.projection, one.projection)


def test_changed_weights_make_another_encoder() -> None:
    changed = load_encoder()
    assert isinstance(changed, LocalEncoder)
    with torch.no_grad():
        next(changed.parameters()).add_(0.5)
    with pytest.raises(InputError, match="no VLAD centroids"):
        vlad_for(changed)


def test_centroids_of_separate_clusters_are_their_means() -> None:
    means = torch.eye(CENTROIDS)
    rows = F.normalize(means.repeat(100, 1) + 0.05 * features(100 * CENTROIDS, CENTROIDS, 3), dim=1)
    centroids = fit_centroids([rows])
    similarity = centroids @ means.T
    # k-means from random rows finds most clusters.
    assert (similarity.max(0).values > 0.98).float().mean() > 0.5


def test_centroids_are_saved_with_their_encoder(tmp_path: Path) -> None:
    encoder, other = tiny(0), tiny(1)
    expected = vlad_for(encoder, [features(200, 8, 0)]).centroids
    save_centroids(encoder, tmp_path / "vlad.safetensors")
    with safe_open(tmp_path / "vlad.safetensors", "pt") as file:
        assert (file.metadata() or {})["encoder"] == module._digest(encoder)
    load_centroids(other, tmp_path / "vlad.safetensors")
    assert torch.equal(vlad_for(other).centroids, expected)


def test_vector_is_the_sum_of_differences_from_the_nearest_centroids() -> None:
    centroids, projection = features(5, 6, 0), torch.randn(30, 12)
    rows = features(40, 6, 1)
    vector = Vlad(centroids, projection)(rows)
    sums = np.zeros((5, 6))
    for row in rows.double().numpy():
        nearest = int(np.argmax([row @ c for c in centroids.double().numpy()]))
        sums[nearest] += row - centroids[nearest].double().numpy()
    lengths = np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    expected = (sums / lengths).ravel() @ projection.double().numpy()
    np.testing.assert_allclose(vector, expected / np.linalg.norm(expected), atol=1e-5)
    assert float(vector.norm()) == pytest.approx(1, abs=1e-5)
