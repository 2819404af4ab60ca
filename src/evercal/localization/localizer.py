"""`Localizer`: an image in, a `PoseEstimate` out.

The way of an image: prepare, encode, retrieve keyframes, match, PnP, align landmarks, accept.
"""

import time
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np

from evercal.errors import InputError
from evercal.features.encoder import Features
from evercal.geometry import SE3, Camera, resize_pixels
from evercal.localization.acceptance import accepted, answer, order, support
from evercal.localization.alignment import align_pose
from evercal.localization.estimate import PoseEstimate
from evercal.localization.intrinsics import (
    FOCAL_FACTORS,
    NOT_STATED,
    UNKNOWN,
    cameras_in_scenes,
    prior_of,
    zoomed,
)
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.localization.matching import Matcher
from evercal.localization.pnp import solve_pnp, uncertain
from evercal.localization.pose_refinement import INTRINSICS
from evercal.localization.query import (
    Attempt,
    Candidate,
    Hypothesis,
    LocalizeOptions,
    Matches,
    Query,
)
from evercal.localization.rivals import settled
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.processes import one_product_thread
from evercal.recordings.images import as_rgb
from evercal.typing import Array, Float32Array, IntArray, PathLike

_NONE = np.zeros((0, 0, 0), np.float32)


class Localizer:
    """Locates images in the scenes of a map."""

    def __init__(self, contents: MapContents, options: LocalizeOptions | None = None):
        self.contents = contents
        self.options = options or LocalizeOptions()
        self._bank = KeyframeBank(contents, self.options.loaded_keyframes)
        self._matcher = Matcher(self._bank, self.options, contents.short_side)

    @classmethod
    def open(
        cls,
        store: PathLike,
        options: LocalizeOptions | None = None,
        encoder: Features | None = None,
    ) -> Self:
        """A localizer for a map on disk.

        For a map that was made with a function of the caller's own, `encoder` is that function.
        """
        contents = MapStore.open(Path(store), encoder).contents
        if not contents.scenes:
            raise InputError(
                f"store {store}: no scene learned yet; run 'evercal learn' first"
            )
        return cls(contents, options)

    def only(self, scene: int, keyframes: IntArray) -> Self:
        """The same localizer with some keyframes of one scene."""
        part = copy(self)
        part._bank = self._bank.only(
            np.flatnonzero(self._bank.scene == scene)[keyframes]
        )
        part._matcher = Matcher(part._bank, self.options, self.contents.short_side)
        return part

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order of learning."""
        return tuple(scene.name for scene in self.contents.scenes)

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        """Estimate the camera pose of one image, or the reason for rejecting it.

        Args:
            image: RGB or grey, uint8, shape (H, W, 3) or (H, W); other arrays are converted, see
                `recordings.as_rgb`.
            camera: Intrinsics, at any size of the image's aspect ratio. Default: those of the
                camera that recorded the scene, as adjusted by the map.
        """
        return self.located(image, camera)[0]

    def located(
        self, image: np.ndarray, camera: Camera | None = None
    ) -> tuple[PoseEstimate, Hypothesis]:
        """`localize`, and the pose in the map's frame, for tracking."""
        with one_product_thread():
            return self._located(as_rgb(image), camera)

    def _located(
        self, image: np.ndarray, camera: Camera | None
    ) -> tuple[PoseEstimate, Hypothesis]:
        began = time.perf_counter()
        contents = self.contents
        cameras = cameras_in_scenes(camera, image, contents.scenes)
        query = self.query(
            image, camera, contents.encoder.encode(image, contents.short_side)
        )
        best = self._best_hypothesis(query, cameras)
        rival = None
        if accepted(best):
            best, rival = settled(self, query, best, cameras[best.scene])
        milliseconds = 1000 * (time.perf_counter() - began)
        scene = contents.scenes[best.scene]
        size = query.image.shape[:2]
        return answer(best, scene, size, milliseconds, rival), best

    def query(
        self,
        image: np.ndarray,
        camera: Camera | None,
        features: Float32Array = _NONE,
    ) -> Query:
        """An image to be located, of the stated camera; alignment alone needs no features."""
        priors = tuple(prior_of(camera, image, scene) for scene in self.contents.scenes)
        return Query(image, features, self.options.patches_short_side, priors)

    def from_pose(
        self, image: np.ndarray, camera: Camera, scene: int, start: SE3
    ) -> PoseEstimate | None:
        """The answer of an alignment that begins at a pose map_from_camera in one scene."""
        [at] = cameras_in_scenes(camera, image, self.contents.scenes[scene : scene + 1])
        query = self.query(image, camera)
        seen = self._bank.seen(scene, start, at)[: self.options.keyframes]
        found = self.aligned(
            query, Candidate(scene, seen), at, start, np.zeros(INTRINSICS)
        )
        return found and answer(
            found, self.contents.scenes[scene], image.shape[:2], 0.0
        )

    def slips(self, hypothesis: Hypothesis) -> Array:
        """(k, 3) displacements, by which an aligned pose may have slipped, the shortest first."""
        found = hypothesis.candidate
        return (
            np.zeros((0, 3)) if found is None else self._bank.pattern(found.keyframes)
        )

    def _best_hypothesis(self, query: Query, cameras: Sequence[Camera]) -> Hypothesis:
        """The pose with the most support, from as few attempts as it takes."""
        best = Hypothesis(0)
        few = False
        for number, attempt in enumerate(self.options.attempts):
            magnified = attempt.scale != 1
            if number > 1 and magnified != few:
                continue
            if magnified:
                query = self._matcher.magnified(query, attempt.scale)
            best = max(best, self._tried(query, attempt, cameras), key=order)
            few = best.pnp_inliers < self.options.aligned_inliers
            # A pose that is barely accepted may be beaten in the next attempt.
            if accepted(best, self.options.immediate):
                break
            if few and not number:  # turned, or of another room
                query = self._matcher.upright(query)
        return best

    def _tried(
        self, query: Query, attempt: Attempt, cameras: Sequence[Camera]
    ) -> Hypothesis:
        """The pose with the most support of one attempt."""
        best = Hypothesis(0)
        for candidate in self._matcher.candidates(query, attempt):
            trial = self.hypothesis(query, candidate, cameras[candidate.scene])
            best = max(best, trial, key=order)
            if accepted(best, self.options.immediate):
                break
        return best

    def hypothesis(
        self,
        query: Query,
        candidate: Candidate,
        camera: Camera,
        matches: Matches | None = None,
    ) -> Hypothesis:
        """A pose in one scene: match, PnP, align; `matches` are used instead of new ones."""
        height, width = query.grey.shape
        small = camera.resized(width, height).short_side_resized(
            self.contents.short_side
        )
        matches = matches or self._matcher.matches(query, candidate, small)
        prior = query.priors[candidate.scene]
        poses = []
        # No camera is stated, and the image was not located at once.
        hard = (
            prior is NOT_STATED and candidate.stride < self.options.attempts[0].stride
        )
        hard &= not len(self._bank.pattern(candidate.keyframes))
        own = replace(self.options.pnp, ranked=prior is not UNKNOWN)
        other = replace(own, max_iterations=own.max_iterations // 2)
        for factor in (1.0, *FOCAL_FACTORS):
            pnp = solve_pnp(
                *matches, small.zoomed(factor), own if factor == 1 else other
            )
            poses += [(pnp, factor)] if pnp else []
            few = not pnp or pnp.inliers.sum() < self.options.aligned_inliers
            if factor == 1 and prior is not UNKNOWN and (few or not hard):
                break
        if not poses:
            return Hypothesis(candidate.scene)
        pnp, factor = max(poses, key=lambda pose: pose[0].inliers.sum())
        inliers = int(pnp.inliers.sum())
        if not self.options.align:
            pixels, points = (values[pnp.inliers] for values in matches)
            pose = uncertain(pixels, points, small.zoomed(factor), pnp.pose)
            count = len(pnp.inliers)
            return Hypothesis(
                candidate.scene, pose, None, pixels, points, count, inliers, inliers
            )
        change = zoomed(factor)
        aligned = self.aligned(query, candidate, camera, pnp.pose, change)
        if aligned is None:
            return Hypothesis(candidate.scene, pnp_inliers=inliers)
        return self._reselected(
            query,
            candidate,
            camera,
            replace(aligned, pnp_inliers=inliers, matches=matches),
        )

    def _reselected(
        self, query: Query, candidate: Candidate, camera: Camera, best: Hypothesis
    ) -> Hypothesis:
        """The pose by the keyframes that see most of its view, while that raises little support."""
        while best.refined and not accepted(best, self.options.immediate):
            pose = best.refined.pose.pose
            change = best.refined.change
            seen = self._bank.seen(candidate.scene, pose, best.refined.camera)
            candidate = candidate._replace(keyframes=seen[: self.options.keyframes])
            again = self.aligned(query, candidate, camera, pose, change)
            if not again or support(again) < self.options.reselect_gain * support(best):
                break
            best = replace(again, pnp_inliers=best.pnp_inliers, matches=best.matches)
        return best

    def aligned(
        self,
        query: Query,
        candidate: Candidate,
        camera: Camera,
        start: SE3,
        change: Array,
        coarse: bool = True,
    ) -> Hypothesis | None:
        """A pose map_from_camera, refined by landmarks; see `align_pose`."""
        options = self.options.alignment
        size = query.grey.shape
        refined = align_pose(
            query.pyramid,
            camera.resized(*size[::-1]),
            [self._bank.load(int(index)).landmarks for index in candidate.keyframes],
            start,
            options,
            query.priors[candidate.scene],
            change,
            coarse,
        )
        if refined is None:
            return None
        observed = refined.observed
        inliers = refined.residual_px < options.inlier_px
        return Hypothesis(
            candidate.scene,
            refined.pose,
            refined,
            resize_pixels(
                observed.pixels[inliers], self.contents.short_side / min(size)
            ),
            observed.points_m[inliers],
            observed.expected,
            len(inliers),
            candidate=candidate,
        )
