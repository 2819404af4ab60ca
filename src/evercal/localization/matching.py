"""Candidate scenes and keyframes of an image, and the 2D-3D matches of its patches."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from evercal.features.views import cell_centres, ideal_cell_pixels, working_grey
from evercal.geometry import Camera, resize_pixels
from evercal.localization.hypothesis import Matches
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.localization.options import Attempt, LocalizeOptions
from evercal.localization.query import Candidate, Encoded, Query
from evercal.typing import Array, Float32Array, Image, IntArray


class Matcher:
    """Retrieval and matching."""

    def __init__(self, bank: KeyframeBank, options: LocalizeOptions, short_side: int):
        self._bank = bank
        self._options = options
        self._short_side = short_side

    def candidates(
        self, query: Query, attempt: Attempt, thorough: bool = False
    ) -> list[Candidate]:
        """Scenes to try, most likely first.

        The global descriptor ranks keyframes, and patches of the image vote among the first ones. A
        scene is tried with the keyframes that got most votes. If these are too few, its next
        keyframes in the ranking are added.
        """
        encoded = query.encoded
        similarity = encoded.similarity
        if similarity is None:
            similarity = self._similarity(encoded.features)[0]
            encoded.similarity = similarity
        proposed = self._bank.ranked(similarity, attempt.retrieved)
        votes = self._votes(encoded, proposed)
        order = np.argsort(-votes, kind="stable")
        scenes = self._bank.scene[proposed]
        total = {
            int(scene): int(votes[scenes == scene].sum()) for scene in np.unique(scenes)
        }
        likely = sorted(total, key=lambda scene: -total[scene])
        enough = self._options.votes * total[likely[0]]
        candidates = []
        for scene in likely[: self._options.candidates]:
            if total[scene] < enough:
                continue
            voted = proposed[order[scenes[order] == scene]]
            ranked = self._bank.ranked_of(scene, similarity)
            others = ranked[~np.isin(ranked, voted)]
            keyframes = np.concatenate([voted, others])[: self._options.keyframes]
            if len(self._bank.pattern(keyframes)) > 0:
                candidates.append(Candidate(scene, keyframes, 1, thorough=True))
            else:
                candidates.append(
                    Candidate(
                        scene, keyframes, attempt.stride, thorough, attempt.tolerance
                    )
                )
        return candidates

    def _votes(self, encoded: Encoded, proposed: IntArray) -> IntArray:
        """(n,) patches of the image that are most similar to each of n keyframes."""
        stride = self._options.retrieval_stride
        best = [self._most_similar(encoded, stride, int(k))[1] for k in proposed]
        return np.bincount(np.argmax(best, 0), minlength=len(proposed))

    def upright(self, query: Query) -> Encoded:
        """The image in the quarter turn whose middle is most similar to keyframes."""
        turns = self._most_similar_view(query, [1, 2, 3], turned)
        if not turns:
            return query.encoded
        grey = working_grey(query.image, self._short_side)
        return Encoded(self._bank.encoder(turned(grey, turns)), turns=turns)

    def mirrored(self, query: Query) -> Query | None:
        """The mirror image in a quarter turn whose middle is more similar to keyframes."""
        number = self._most_similar_view(query, [1, 2, 3, 4], _mirror)
        if not number:
            return None
        image = _mirror(query.image, 1)
        cameras = []
        for camera in query.cameras:
            cameras.append(replace(camera, cx=camera.width - 1 - camera.cx))
        grey = working_grey(image, self._short_side)
        turns = number - 1
        encoded = Encoded(self._bank.encoder(turned(grey, turns)), turns=turns)
        return replace(query, image=image, cameras=cameras, encoded=encoded)

    def _most_similar_view(
        self, query: Query, views: list[int], view: Callable[[Image, int], Image]
    ) -> int:
        """The view whose middle is clearly more similar to keyframes than the image; or 0."""
        grey = working_grey(query.image, self._short_side)
        encoder = self._bank.encoder
        features = query.encoded.features
        stride = encoder.stride
        rows, columns = features.shape[:2]
        side = min(self._options.middle_px // stride, rows, columns)
        top = (rows - side) // 2
        left = (columns - side) // 2
        middle = grey[stride * top :, stride * left :][: stride * side, : stride * side]
        # Side by side, three turns take two thirds of the time.
        others = encoder(np.concatenate([view(middle, number) for number in views], 1))
        middles = [
            features[top : top + side, left : left + side],
            *np.split(others, len(views), 1),
        ]
        similar = []
        for each, similarity in zip(middles, self._similarity(*middles), strict=True):
            similar.append(self._mean_similarity(each, similarity))
        best = int(np.argmax(similar))
        if similar[best] <= similar[0] + self._options.clear_turn:
            return 0
        return views[best - 1]

    def magnified(self, query: Query, scale: float) -> Encoded:
        """The image encoded at another size."""
        short_side = round(scale * self._short_side)
        return Encoded(self._bank.encoder.encode(query.image, short_side), scale=scale)

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
        rows = _rows(features[::2, ::2])
        best = []
        for keyframe in self._bank.ranked(similarity, self._options.keyframes):
            cells = self._bank.load(int(keyframe)).cells
            best.append((rows @ cells.features.T).max(1))
        return float(np.max(best, 0).mean())

    def matches(self, query: Query, candidate: Candidate, camera: Camera) -> Matches:
        """Match patches to the points of a scene's keyframes, the most similar first.

        The camera is that at the working size.
        """
        encoded = query.encoded
        stride = candidate.stride
        if not self._options.align:
            stride = 1
        larger = camera.short_side_resized(round(encoded.scale * self._short_side))
        patches, pixels = strided_patches(
            encoded, larger, self._bank.encoder.stride, stride
        )
        pixels = resize_pixels(pixels, 1 / encoded.scale)
        with_ray = np.isin(_grid(encoded, stride), patches)
        points = []
        similarity = []
        for keyframe in candidate.keyframes:
            nearest, similar = self._most_similar(encoded, stride, int(keyframe))
            points.append(nearest[with_ray])
            similarity.append(similar[with_ray])
        similarity = np.array(similarity)
        points = np.array(points)[similarity.argmax(0), np.arange(len(pixels))]
        order = np.argsort(-similarity.max(0), kind="stable")
        return Matches(pixels[order], points[order])

    def _most_similar(
        self, encoded: Encoded, stride: int, keyframe: int
    ) -> tuple[Array, Float32Array]:
        """Point (n, 3) and similarity (n,) of the cell of a keyframe most similar to each patch.

        Patches are those of every `stride`-th row and column. Retrieval and matches share them.
        """
        key = stride, keyframe
        if key not in encoded.nearest:
            rows = _rows(encoded.features)[_grid(encoded, stride)]
            cells = self._bank.load(keyframe).cells
            similarity = rows @ cells.features.T
            nearest = similarity.argmax(1)
            best = similarity[np.arange(len(rows)), nearest]
            encoded.nearest[key] = cells.points_m[nearest], best
        return encoded.nearest[key]


def _grid(encoded: Encoded, stride: int) -> IntArray:
    """Indices (n,) of the patches of every `stride`-th row and column."""
    rows, columns = encoded.features.shape[:2]
    return np.arange(rows * columns).reshape(rows, columns)[::stride, ::stride].ravel()


def _mirror(image: Image, number: int) -> Image:
    """An image mirrored left to right (1), and then turned by quarters (2, 3, 4)."""
    return turned(np.flip(image, 1), number - 1)


def turned(image: Image, turns: int) -> Image:
    """An image after quarter turns clockwise."""
    return np.ascontiguousarray(np.rot90(image, -turns))


def strided_patches(
    encoded: Encoded, camera: Camera, encoder_stride: int, stride: int
) -> tuple[IntArray, Array]:
    """Indices (m,) and ideal pixels (m, 2) of patches of every n-th row and column with a ray."""
    patches = _grid(encoded, stride)
    pixels = cell_pixels(camera, encoder_stride, encoded.turns)[patches]
    valid = np.isfinite(pixels).all(1)
    return patches[valid], pixels[valid]


def cell_pixels(camera: Camera, stride: int, turns: int) -> Array:
    """(cells, 2) ideal pixels of the cells of an image that was encoded with quarter turns.

    Cells are in the order of the turned image, pixels in the axes of the upright one.
    """
    if not turns:
        return ideal_cell_pixels(camera, stride).astype(float)
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
    upright = {1: (y, bottom - x), 2: (right - x, bottom - y), 3: (right - y, x)}
    pixels = np.stack(upright[turns], -1)
    return camera.pinhole.project(camera.unproject(pixels))


def _rows(features: Float32Array) -> Float32Array:
    return features.reshape(-1, features.shape[2])
