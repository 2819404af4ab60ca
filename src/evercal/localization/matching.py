"""Which scenes and keyframes an image may show, and what its patches match there."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from torch import Tensor

from evercal.features.precision import autocast
from evercal.features.views import ideal_cell_pixels
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.localization.query import Attempt, Candidate, LocalizeOptions, Query
from evercal.mapping.scene_maps import SceneMaps


class Matcher:
    """Retrieval and matching for a store.

    Args:
        maps: encoder, scene records, keyframes and networks.
        bank: the keyframes of all scenes.
        options: how.
    """

    def __init__(self, maps: SceneMaps, bank: KeyframeBank, options: LocalizeOptions):
        self._maps, self._bank, self._options = maps, bank, options
        self._prototypes = [record.prototypes.float().to(maps.device) for record in maps.scenes]

    def candidates(
        self, query: Query, usable: list[int], attempt: Attempt, one_answer: bool
    ) -> list[Candidate]:
        """Scenes to try, the likeliest first.

        Args:
            query: the image.
            usable: scenes whose camera fits the image.
            attempt: how much work the image gets.
            one_answer: the network itself decides which scene answers.
        """
        features = query.features.flatten(1).T
        ranked = self._bank.retrieve(features, usable)
        if len(ranked):
            return self._voted(features, ranked, attempt)
        none = np.zeros(0, np.int64)
        if one_answer:
            return [Candidate(usable[0], none)]
        descriptor = self._descriptor(query)
        likeness = {i: float((self._prototypes[i] @ descriptor).max()) for i in usable}
        usable.sort(key=lambda i: -likeness[i])
        floor = likeness[usable[0]] - self._options.margin
        likely = [i for i in usable if likeness[i] >= floor][: self._options.candidates]
        return [Candidate(i, none) for i in likely]

    @torch.inference_mode()
    def _voted(
        self, features: Tensor, ranked: NDArray[np.int64], attempt: Attempt
    ) -> list[Candidate]:
        """Patches of the image vote for the keyframes that rank first, and so for scenes.

        A scene is tried with the keyframes that got most votes, and where these are too few, with
        those of its others whose descriptors are most alike.
        """
        proposed, rest = ranked[: attempt.retrieved], ranked[attempt.retrieved :]
        some = features[:: self._options.retrieval_stride]
        best = []
        for index in proposed:
            keys = self._bank.load(int(index)).cells.features
            best.append(_bits(some.to(keys.dtype) @ keys.T).max(1))
        votes = np.bincount(np.argmax(best, 0), minlength=len(proposed))
        order = np.argsort(-votes, kind="stable")
        scene = self._bank.scene[proposed]
        total = {int(s): int(votes[scene == s].sum()) for s in np.unique(scene)}
        likely = sorted(total, key=lambda s: -total[s])[: self._options.candidates]
        enough = self._options.votes * total[likely[0]]
        found = []
        for s in likely:
            voted = proposed[order[scene[order] == s]]
            others = rest[self._bank.scene[rest] == s]
            if total[s] >= enough:
                both = np.concatenate([voted, others])[: self._options.keyframes]
                found.append(Candidate(s, both, attempt.match_stride))
        return found

    @torch.inference_mode()
    def _descriptor(self, query: Query) -> Tensor:
        return self._maps.descriptor(query.features[None])[0]

    @torch.inference_mode()
    def correspondences(
        self, query: Query, candidate: Candidate, camera: Camera, near: SE3 | None = None
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """What is matched to points of a scene.

        Args:
            query: the image.
            candidate: the scene and its keyframes.
            camera: intrinsics of the image.
            near: base_from_camera, roughly: a patch is then matched only to points that it would
                show within `LocalizeOptions.guided_px` of itself.

        Returns:
            Pixels (m, 2) at the encoder's working size, points (m, 3) in the scene's base frame,
            and how many patches of the image they stand for.
        """
        small = camera.short_side_resized(self._maps.short_side)
        pixels = ideal_cell_pixels(small, self._maps.encoder.stride).astype(np.float64)
        features = query.features.flatten(1).T
        some = self._strided(query, candidate)
        some = some[np.isfinite(pixels[some]).all(1)]
        points = []
        if len(candidate.keyframes):
            matched = self._matched(features[some], candidate.keyframes, pixels[some], small, near)
            points.append(matched)
        if self._maps.heads:
            points.append(self._predicted(query, candidate.scene)[some])
        told = np.concatenate(points)
        known = np.isfinite(told).all(1)
        return np.tile(pixels[some], (len(points), 1))[known], told[known], len(some)

    def _strided(self, query: Query, candidate: Candidate) -> NDArray[np.int64]:
        """The patches of the image that are matched to keyframes."""
        rows, columns = query.features.shape[1:]
        step = candidate.match_stride if self._options.align else 1
        return np.arange(rows * columns).reshape(rows, columns)[::step, ::step].ravel()

    def _matched(
        self,
        features: Tensor,
        keyframes: NDArray[np.int64],
        pixels: np.ndarray,
        camera: Camera,
        near: SE3 | None,
    ) -> np.ndarray:
        """(n, 3) points of the keyframes' patches that are most similar to (n, channels).

        NaN where no patch of a keyframe is `near`.
        """
        loaded = [self._bank.load(int(index)).cells for index in keyframes]
        features = features.to(loaded[0].features.dtype)
        # One keyframe after the other: the products of all would not fit the processor's cache.
        likeness = [_bits(features @ keyframe.features.T) for keyframe in loaded]
        if near is not None:
            likeness = [
                some * self._within(pixels, keyframe.points_m, camera, near)
                for some, keyframe in zip(likeness, loaded, strict=True)
            ]
        nearest = np.array([some.argmax(1) for some in likeness])
        rows = np.arange(len(features))
        height = np.array([some[rows, k] for some, k in zip(likeness, nearest, strict=True)])
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
        """(n, m) which of m points a camera would show within reach of n pixels."""
        local = near.inverse().apply(points_m)
        focal, centre = [camera.fx, camera.fy], [camera.cx, camera.cy]
        shown = local[:, :2] / np.maximum(local[:, 2:], 1e-3) * focal + centre
        shown = np.where(local[:, 2:] > 0, shown, np.inf)
        return cdist(pixels, shown, "sqeuclidean") < self._options.guided_px**2

    def _predicted(self, query: Query, scene: int) -> np.ndarray:
        """(cells, 3) points that the network predicts, in the scene's base frame."""
        head, local = self._maps.head_for(scene)
        features = query.features.flatten(1).T.to(head.device)
        descriptor = self._descriptor(query).to(head.device)
        with autocast(head.device):
            output = head(features, local, descriptor.expand(len(features), -1))
        points = output.points.cpu().double().numpy()
        return self._maps.scenes[scene].cell.atlas_from_base.inverse().apply(points)


def _bits(value: Tensor) -> np.ndarray:
    """Numbers (n, m) as whole numbers in the same order, where they are positive.

    numpy finds the largest of those in a hundredth of the time that torch takes for bfloat16.
    """
    kind = torch.int16 if value.dtype == torch.bfloat16 else torch.int32
    return value.contiguous().view(kind).cpu().numpy()
