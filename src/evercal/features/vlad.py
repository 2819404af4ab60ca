"""VLAD: one vector for an image, to retrieve similar images (Jegou et al., CVPR 2010).

The features of an image are summed as differences from the nearest of a few centroids. Centroids of
the shipped encoder come from procedural rooms. Centroids of another encoder are fitted to the first
recording that is learned with it, and travel with the map.
"""

from collections.abc import Sequence

import numpy as np

from evercal.geometry.normal_equations import gram
from evercal.typing import Array, Float32Array

CENTROIDS = 16
"""Number of centroids."""
WIDTH = 1024
"""Maximum length of the vector of an image."""
_ROUNDS = 15
"""Iterations of k-means."""
_ROWS = 40_000
"""Maximum number of features that centroids are fitted to."""


class Vlad:
    """Aggregate the features of an image in one vector; centroids (k, channels) are unit vectors.

    More numbers than `WIDTH` are projected to so many.
    """

    def __init__(self, centroids: Float32Array):
        self.centroids = centroids
        size = centroids.size
        self._projection = None
        if size > WIDTH:
            self._projection = _random_projection(size)

    def __call__(self, features: Float32Array) -> Float32Array:
        """(cells, channels) unit vectors of an image -> unit vector of at most `WIDTH` numbers."""
        sums = _sums(features, self.centroids, self.centroids)
        vector = unit(sums).ravel()
        if self._projection is not None:
            vector = vector @ self._projection
        return unit(vector)


def fit_centroids(features: Sequence[Float32Array]) -> Float32Array:
    """(k, channels) centroids of unit features (cells, channels) of images, spherical k-means."""
    rows = np.concatenate(list(features))
    rows = rows.astype(np.float32)
    rng = np.random.default_rng(0)
    rows = rng.permutation(rows)[:_ROWS]
    centroids = rows[:CENTROIDS]
    for _ in range(_ROUNDS):
        sums = _sums(rows, centroids)
        # A centroid without members stays where it is.
        size = np.abs(sums).sum(1, keepdims=True)
        centroids = np.where(size > 0, unit(sums), centroids)
    return centroids


def _sums(
    rows: Float32Array, centroids: Float32Array, origin: Float32Array | None = None
) -> Float32Array:
    """(k, channels) sums of the rows nearest to each centroid, as differences from an origin."""
    similarity = rows @ centroids.T
    nearest = similarity.argmax(1)
    member = np.zeros(similarity.shape[::-1], np.float32)
    member[nearest, np.arange(len(rows))] = 1
    sums = member @ rows
    if origin is None:
        return sums
    counts = member.sum(1, keepdims=True)
    return sums - counts * origin


def unit(vectors: Array) -> Float32Array:
    """Vectors (..., n) of unit length."""
    squares = np.einsum("...c,...c->...", vectors, vectors)
    length = np.sqrt(squares)
    length = np.maximum(length, 1e-12)
    return np.asarray(vectors / length[..., None], np.float32)


def _random_projection(size: int) -> Float32Array:
    """(size, WIDTH) fixed random projection, which preserves angles: Box-Muller by blocks of 16."""
    # The numbers are part of every map that was ever made with a projection.
    count = size * WIDTH
    rng = np.random.RandomState(1)
    bits = rng.randint(0, 2**32, count, dtype=np.uint32)
    uniform = (bits & 0xFFFFFF) * np.float32(2**-24)
    uniform = uniform.astype(np.float32)
    uniform = uniform.reshape(-1, 2, 8)
    squares = -2 * np.log1p(-uniform[:, 0])
    radius = np.sqrt(squares)
    radius = radius / np.float32(size) ** 0.5
    angle = np.float32(2 * np.pi) * uniform[:, 1]
    x = radius * np.cos(angle)
    y = radius * np.sin(angle)
    normal = np.stack([x, y], 1)
    return np.asarray(normal, np.float32).reshape(size, WIDTH)


def similar_pairs(
    features: Sequence[Float32Array], vlad: Vlad, partners: int
) -> list[tuple[int, int]]:
    """Pairs of images, each with the most similar other ones, by features (cells, channels)."""
    descriptors = np.stack([vlad(rows) for rows in features])
    similarity = gram(descriptors)
    np.fill_diagonal(similarity, -np.inf)
    count = min(partners, len(features) - 1)
    order = np.argsort(-similarity, 1, kind="stable")
    nearest = order[:, :count].tolist()
    pairs = set()
    for i, row in enumerate(nearest):
        for j in row:
            pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)
