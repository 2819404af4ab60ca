"""Candidate scenes and keyframes of an image, and the 2D-3D matches of its patches."""

from dataclasses import replace

import numpy as np

from evercal.features.views import cell_centres, ideal_cell_pixels, working_grey
from evercal.geometry import Camera, resize_pixels
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.localization.query import (
    Attempt,
    Candidate,
    LocalizeOptions,
    Matches,
    Query,
)
from evercal.typing import Float32Array, IntArray


class Matcher:
    """Retrieval and matching."""

    def __init__(self, bank: KeyframeBank, options: LocalizeOptions, short_side: int):
        self._bank = bank
        self._options = options
        self._short_side = short_side

    def candidates(self, query: Query, attempt: Attempt) -> list[Candidate]:
        """Scenes to try, most likely first.

        The global descriptor ranks keyframes, and patches of the image vote among the first ones. A
        scene is tried with the keyframes that got most votes. If these are too few, its next
        keyframes in the ranking are added.
        """
        if not query.descriptor:
            query.descriptor.append(self._similarity(query.features)[0])
        similarity = query.descriptor[0]
        proposed = self._bank.ranked(similarity, attempt.retrieved)
        stride = self._options.retrieval_stride
        best = [self._most_similar(query, stride, int(index))[1] for index in proposed]
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
            own = self._bank.ranked_of(s, similarity)
            others = own[~np.isin(own, voted)]
            keyframes = np.concatenate([voted, others])[: self._options.keyframes]
            repeated = len(self._bank.pattern(keyframes)) > 0
            candidates.append(
                Candidate(s, keyframes, 1 if repeated else attempt.stride)
            )
        return candidates

    def upright(self, query: Query) -> Query:
        """The image in the quarter turn whose middle is most similar to keyframes."""
        grey = working_grey(query.image, self._short_side)
        encoder = self._bank.encoder
        size = query.features.shape[:2]
        stride = encoder.stride
        side = min(self._options.middle_px // stride, *size)
        top, left = ((cells - side) // 2 for cells in size)
        middle = grey[stride * top :, stride * left :][: stride * side, : stride * side]
        # Side by side, the other turns take two thirds of the time.
        others = encoder(
            np.concatenate([turned(middle, turns) for turns in (1, 2, 3)], 1)
        )
        views = (
            query.features[top : top + side, left : left + side],
            *np.split(others, 3, 1),
        )
        similarity = self._similarity(*views)
        similar = [
            self._mean_similarity(*each) for each in zip(views, similarity, strict=True)
        ]
        turns = int(np.argmax(similar))
        if similar[turns] <= similar[0] + self._options.clear_turn:
            return query
        features = encoder(turned(grey, turns))
        return replace(query, features=features, turns=turns, similar={}, descriptor=[])

    def magnified(self, query: Query, scale: float) -> Query:
        """The image encoded at another size."""
        features = self._bank.encoder.encode(
            query.image, round(scale * self._short_side)
        )
        return replace(
            query, features=features, scale=scale, turns=0, similar={}, descriptor=[]
        )

    def _similarity(self, *views: Float32Array) -> Float32Array:
        """(views, keyframes) similarity of whole images by their features."""
        vlad = self._bank.encoder.vlad()
        return self._bank.similarity(*(vlad(_rows(features)) for features in views))

    def _mean_similarity(
        self, features: Float32Array, similarity: Float32Array
    ) -> float:
        """Mean similarity of every second row and column of features (rows, columns, channels).

        Each is compared to its most similar cell in the keyframes that match best.
        """
        proposed = self._bank.ranked(similarity, self._options.keyframes)
        rows = _rows(features[::2, ::2])
        best = [
            (rows @ self._bank.load(int(k)).cells.features.T).max(1) for k in proposed
        ]
        return float(np.max(best, 0).mean())

    def matches(self, query: Query, candidate: Candidate, camera: Camera) -> Matches:
        """Match patches to the points of a scene's keyframes, the most similar first.

        The camera is that at the working size.
        """
        stride = candidate.stride if self._options.align else 1
        larger = camera.short_side_resized(round(query.scale * self._short_side))
        patches, pixels = strided_patches(
            query, larger, self._bank.encoder.stride, stride
        )
        pixels = resize_pixels(pixels, 1 / query.scale)
        found = [self._most_similar(query, stride, int(k)) for k in candidate.keyframes]
        nearest, height = (np.array(values) for values in zip(*found, strict=True))
        with_ray = np.isin(_grid(query, stride), patches)
        nearest = nearest[:, with_ray]
        best = height[:, with_ray].argmax(0)
        points = np.empty((len(pixels), 3))
        for number, keyframe in enumerate(candidate.keyframes):
            chosen = best == number
            points[chosen] = self._bank.load(int(keyframe)).cells.points_m[
                nearest[number, chosen]
            ]
        order = np.argsort(-height[:, with_ray].max(0), kind="stable")
        return Matches(pixels[order], points[order])

    def _most_similar(
        self, query: Query, stride: int, keyframe: int
    ) -> tuple[IntArray, Float32Array]:
        """Index and similarity (n,) of the cell of a keyframe that is most similar to each patch.

        Patches are those of every `stride`-th row and column. Retrieval and matches share them.
        """
        key = stride, keyframe
        if key not in query.similar:
            rows = _rows(query.features)[_grid(query, stride)]
            similarity = rows @ self._bank.load(keyframe).cells.features.T
            nearest = similarity.argmax(1)
            query.similar[key] = nearest, similarity[np.arange(len(rows)), nearest]
        return query.similar[key]


def _grid(query: Query, stride: int) -> IntArray:
    """Indices (n,) of the patches of every `stride`-th row and column."""
    rows, columns = query.features.shape[:2]
    return np.arange(rows * columns).reshape(rows, columns)[::stride, ::stride].ravel()


def turned(image: np.ndarray, turns: int) -> np.ndarray:
    """An image after quarter turns clockwise."""
    return np.ascontiguousarray(np.rot90(image, -turns))


def strided_patches(
    query: Query, camera: Camera, encoder_stride: int, stride: int
) -> tuple[IntArray, np.ndarray]:
    """Indices (m,) and ideal pixels (m, 2) of patches of every n-th row and column with a ray."""
    patches = _grid(query, stride)
    pixels = cell_pixels(camera, encoder_stride, query.turns)[patches]
    valid = np.isfinite(pixels).all(1)
    return patches[valid], pixels[valid]


def cell_pixels(camera: Camera, stride: int, turns: int) -> np.ndarray:
    """(cells, 2) ideal pixels of the cells of an image that was encoded with quarter turns.

    Cells are in the order of the turned image, pixels in the axes of the upright one.
    """
    if not turns:
        return ideal_cell_pixels(camera, stride).astype(np.float64)
    right = camera.width - 1
    bottom = camera.height - 1
    rows = camera.height
    columns = camera.width
    if turns % 2:
        rows, columns = columns, rows
    turned = cell_centres(rows, columns, stride)
    x = turned[:, 0]
    y = turned[:, 1]
    # Clockwise by one quarter, pixel (x, y) moves to (height - 1 - y, x).
    back = {1: (y, bottom - x), 2: (right - x, bottom - y), 3: (right - y, x)}[turns]
    return camera.pinhole.project(camera.unproject(np.stack(back, -1)))


def _rows(features: Float32Array) -> Float32Array:
    return features.reshape(-1, features.shape[2])
