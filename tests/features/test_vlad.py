"""VLAD: shipped and fitted centroids, and sums against a slow twin."""

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.features.encoder import load_encoder
from evercal.features.vlad import (
    CENTROIDS,
    WIDTH,
    Vlad,
    fit_centroids,
    similar_pairs,
)
from evercal.typing import Array

from ..encoders import tiny_encoder


def features(count: int, width: int, seed: int) -> Array:
    drawn = np.random.default_rng(seed).normal(size=(count, width)).astype(np.float32)
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def test_shipped_centroids_are_unit_vectors_that_differ() -> None:
    encoder = load_encoder()
    vlad = encoder.vlad()
    assert vlad.centroids.shape == (CENTROIDS, encoder.width)
    np.testing.assert_allclose(np.linalg.norm(vlad.centroids, axis=1), 1, atol=1e-3)
    similarity = vlad.centroids @ vlad.centroids.T - 2 * np.eye(CENTROIDS)
    assert similarity.max() < 0.95
    assert encoder.vlad() is vlad


def test_another_encoder_has_centroids_of_given_features() -> None:
    encoder = tiny_encoder(0)
    other = tiny_encoder(1)
    with pytest.raises(InputError, match="no VLAD centroids; learn a recording"):
        encoder.vlad()
    images = [features(50, 8, seed) for seed in range(4)]
    one = encoder.vlad(images)
    two = other.vlad([-image for image in images])
    for vlad in (one, two):
        assert vlad.centroids.shape == (CENTROIDS, 8)
        np.testing.assert_allclose(np.linalg.norm(vlad.centroids, axis=1), 1, atol=1e-5)
    assert not np.allclose(one.centroids, two.centroids, atol=1e-2)
    # They are fitted once, and the fit is deterministic.
    assert encoder.vlad() is encoder.vlad(images[:1]) is one
    np.testing.assert_array_equal(fit_centroids(images), one.centroids)


def test_centroids_of_separate_clusters_are_their_means() -> None:
    means = np.eye(CENTROIDS, dtype=np.float32)
    rows = np.tile(means, (100, 1)) + 0.05 * features(100 * CENTROIDS, CENTROIDS, 3)
    similarity = (
        fit_centroids([rows / np.linalg.norm(rows, axis=1, keepdims=True)]) @ means.T
    )
    # k-means from random rows finds most clusters.
    assert (similarity.max(0) > 0.98).mean() > 0.5


def by_hand(rows: Array, centroids: Array) -> Array:
    """Unit sums of the differences from each centroid, one after the other."""
    sums = np.zeros(centroids.shape)
    for row in rows.astype(float):
        nearest = int(np.argmax(centroids @ row))
        sums[nearest] += row - centroids[nearest]
    return (
        sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    ).ravel()


def test_vector_is_the_sum_of_differences_from_the_nearest_centroids() -> None:
    centroids = features(5, 6, 0)
    rows = features(40, 6, 1)
    vector = Vlad(centroids)(rows)
    np.testing.assert_allclose(vector, by_hand(rows, centroids) / 5**0.5, atol=1e-5)
    assert float(np.linalg.norm(vector)) == pytest.approx(1, abs=1e-5)


def test_long_vectors_are_projected_by_numbers_that_never_change() -> None:
    """Those of `torch.randn` with seed 1, which maps of before were made with."""
    torch = pytest.importorskip("torch")
    centroids = features(32, 64, 0)
    rows = features(40, 64, 1)
    size = centroids.size
    generator = torch.Generator().manual_seed(1)
    projection = torch.randn(size, WIDTH, generator=generator).numpy() / size**0.5
    vlad = Vlad(centroids)
    assert vlad._projection is not None
    np.testing.assert_allclose(vlad._projection, projection, rtol=1e-4, atol=1e-7)
    vector = vlad(rows)
    plain = Vlad(centroids[:16])(rows)
    assert vector.shape == plain.shape == (WIDTH,)
    expected = by_hand(rows, centroids) @ projection
    np.testing.assert_allclose(vector, expected / np.linalg.norm(expected), atol=1e-5)


def test_every_image_is_paired_with_the_most_similar_ones() -> None:
    images = [features(60, 8, seed) for seed in range(3)]
    images += [
        np.asarray(image + 0.01 * features(60, 8, 9), np.float32) for image in images
    ]
    pairs = similar_pairs(images, Vlad(features(4, 8, 1)), 1)
    assert pairs == [(0, 3), (1, 4), (2, 5)]
    assert similar_pairs(images[:2], Vlad(features(4, 8, 1)), 5) == [(0, 1)]


@pytest.mark.parametrize("partners", [1, 3, 20])
def test_pairs_are_those_of_a_search_one_by_one(partners: int) -> None:
    images = [features(30, 8, seed) for seed in range(12)]
    vlad = Vlad(features(4, 8, 1))
    vectors = [vlad(image) for image in images]
    expected = set()
    for i, one in enumerate(vectors):
        others = [j for j in range(len(images)) if j != i]
        others.sort(key=lambda j: -float(one @ vectors[j]))
        expected |= {tuple(sorted((i, j))) for j in others[:partners]}
    assert similar_pairs(images, vlad, partners) == sorted(expected)
