"""Candidate scenes and keyframes of an image, and the 2D-3D matches of its patches."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from evercal.features.views import cell_centres, ideal_cell_pixels
from evercal.geometry import SE3, Camera
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.localization.query import Attempt, Candidate, LocalizeOptions, Matches, Query


class Matcher:
    """Retrieval and matching."""

    def __init__(self, bank: KeyframeBank, options: LocalizeOptions):
        self._bank, self._options = bank, options

    def candidates(self, query: Query, attempt: Attempt) -> list[Candidate]:
        """Scenes to try, most likely first.

        The global descriptor ranks keyframes, and patches of the image vote among the first ones. A
        scene is tried with the keyframes that got most votes. If these are too few, its next
        keyframes in the ranking are added.
        """
        features = _rows(query.features)
        ranked = self._bank.retrieve(features)
        proposed, rest = ranked[: attempt.retrieved], ranked[attempt.retrieved :]
        sample = features[:: self._options.retrieval_stride]
        best = []
        for index in proposed:
            keys = self._bank.load(int(index)).cells.features
            best.append((sample @ keys.T).max(1))
        votes = np.bincount(np.argmax(best, 0), minlength=len(proposed))
        order = np.argsort(-votes, kind="stable")
        scene = self._bank.scene[proposed]
        total = {int(s): int(votes[scene == s].sum()) for s in np.unique(scene)}
        likely = sorted(total, key=lambda s: -total[s])[: self._options.candidates]
        enough = self._options.votes * total[likely[0]]
        candidates = []
        for s in likely:
            if total[s] < enough:
                continue
            voted = proposed[order[scene[order] == s]]
            others = rest[self._bank.scene[rest] == s]
            keyframes = np.concatenate([voted, others])[: self._options.keyframes]
            candidates.append(Candidate(s, keyframes, attempt.match_stride, attempt.unknown_camera))
        return candidates

    def matches(
        self, query: Query, candidate: Candidate, camera: Camera, near: SE3 | None = None
    ) -> Matches:
        """Match patches of the image to the points of a scene's keyframes.

        The camera is at the encoder's working size. If `near`, roughly map_from_camera, is given, a
        patch is matched only to points that project within `LocalizeOptions.guided_px` of it.
        """
        stride = candidate.match_stride if self._options.align else 1
        patches, pixels = strided_patches(query, camera, self._bank.encoder.stride, stride)
        features = _rows(query.features)[patches]
        points = self._nearest(features, candidate.keyframes, pixels, camera, near)
        valid = np.isfinite(points).all(1)
        return Matches(pixels[valid], points[valid])

    def _nearest(
        self,
        features: NDArray[np.float32],
        keyframes: NDArray[np.int64],
        pixels: np.ndarray,
        camera: Camera,
        near: SE3 | None,
    ) -> np.ndarray:
        """(n, 3) points of the patches most similar to features (n, channels); else NaN."""
        loaded = [self._bank.load(int(index)).cells for index in keyframes]
        # One keyframe at a time: the products of all would not fit the processor's cache.
        similarity = [features @ keyframe.features.T for keyframe in loaded]
        if near is not None:
            similarity = [
                values * self._within(pixels, keyframe.points_m, camera, near)
                for values, keyframe in zip(similarity, loaded, strict=True)
            ]
        nearest = np.array([values.argmax(1) for values in similarity])
        rows = np.arange(len(features))
        height = np.array([v[rows, k] for v, k in zip(similarity, nearest, strict=True)])
        best = height.argmax(0)
        points = np.empty((len(features), 3))
        for number, keyframe in enumerate(loaded):
            points[best == number] = keyframe.points_m[nearest[number, best == number]]
        if near is not None:
            points[height.max(0) <= 0] = np.nan
        return points

    def _within(
        self, pixels: np.ndarray, points_m: np.ndarray, camera: Camera, near: SE3
    ) -> NDArray[np.bool_]:
        projected = camera.pinhole.project(near.inverse().apply(points_m))
        projected = np.where(np.isnan(projected), np.inf, projected)
        return cdist(pixels, projected, "sqeuclidean") < self._options.guided_px**2


def strided_patches(
    query: Query, camera: Camera, encoder_stride: int, stride: int
) -> tuple[NDArray[np.int64], np.ndarray]:
    """Indices (m,) and ideal pixels (m, 2) of patches of every n-th row and column with a ray."""
    rows, columns = query.features.shape[:2]
    patches = np.arange(rows * columns).reshape(rows, columns)[::stride, ::stride].ravel()
    pixels = cell_pixels(camera, encoder_stride, query.turns)[patches]
    valid = np.isfinite(pixels).all(1)
    return patches[valid], pixels[valid]


def cell_pixels(camera: Camera, stride: int, turns: int) -> np.ndarray:
    """(cells, 2) ideal pixels of the cells of an image that was encoded with quarter turns.

    Cells are in the order of the turned image, pixels in the axes of the upright one.
    """
    if not turns:
        return ideal_cell_pixels(camera, stride).astype(np.float64)
    right, bottom = camera.width - 1, camera.height - 1
    rows, columns = camera.height, camera.width
    if turns % 2:
        rows, columns = columns, rows
    turned = cell_centres(rows, columns, stride)
    x, y = turned[:, 0], turned[:, 1]
    # Clockwise by one quarter, pixel (x, y) moves to (height - 1 - y, x).
    back = {1: (y, bottom - x), 2: (right - x, bottom - y), 3: (right - y, x)}[turns]
    return camera.pinhole.project(camera.unproject(np.stack(back, -1)))


def _rows(features: NDArray[np.float32]) -> NDArray[np.float32]:
    return features.reshape(-1, features.shape[2])
