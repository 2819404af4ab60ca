"""`Localizer`: an image in, a `PoseEstimate` out.

The way of an image: prepare, encode, retrieve keyframes, match, PnP, align landmarks, accept.
"""

from collections.abc import Iterable
from copy import copy
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Self

import numpy as np

from evercal.errors import InputError
from evercal.features.encoder import Features
from evercal.geometry import SE3, Camera
from evercal.localization.answer import answer
from evercal.localization.estimate import PoseEstimate
from evercal.localization.hypothesis import Aligned, Hypothesis, accepted, order
from evercal.localization.intrinsics import (
    INTRINSICS,
    IntrinsicsPrior,
    cameras_in_scenes,
    prior_of,
)
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.localization.options import Attempt, LocalizeOptions
from evercal.localization.other_bases import InBase, in_other_base
from evercal.localization.query import Candidate, Encoded, Query
from evercal.localization.rivals import settled
from evercal.localization.scene_poses import ScenePoses
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.processes import one_product_thread
from evercal.recordings.images import as_rgb
from evercal.typing import Image, IntArray, PathLike, Strings

MIRRORED = 4.0
"""The mirror image is tried where no pose has this many times the required support."""


class Localizer:
    """Locates images in the scenes of a map."""

    def __init__(self, contents: MapContents, options: LocalizeOptions | None = None):
        self.contents = contents
        self.options = options or LocalizeOptions()
        bank = KeyframeBank(contents, self.options.loaded_keyframes)
        self.poses = ScenePoses(contents, bank, self.options)

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

    def within(self, names: Iterable[str]) -> Self:
        """The same localizer that locates images in some scenes only."""
        wanted = self.contents.within(names).names
        numbers = [self.contents.names.index(name) for name in wanted]
        return self._with(np.flatnonzero(np.isin(self.poses.bank.scene, numbers)))

    def only(self, scene: int, keyframes: IntArray) -> Self:
        """The same localizer with some keyframes of one scene."""
        of_scene = np.flatnonzero(self.poses.bank.scene == scene)
        return self._with(of_scene[keyframes])

    def _with(self, keyframes: IntArray) -> Self:
        bank = self.poses.bank.only(keyframes)
        restricted = copy(self)
        restricted.poses = ScenePoses(self.contents, bank, self.options)
        return restricted

    @property
    def scenes(self) -> Strings:
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
    ) -> tuple[PoseEstimate, Hypothesis | None]:
        """`localize`, and the pose in the map's frame, for tracking."""
        with one_product_thread():
            return self._located(as_rgb(image), camera)

    def _located(
        self, image: Image, camera: Camera | None
    ) -> tuple[PoseEstimate, Hypothesis | None]:
        began = perf_counter()
        contents = self.contents
        query = self.query(image, camera)
        features = contents.encoder.encode(image, contents.short_side)
        query = replace(query, encoded=Encoded(features))
        best = self._best_hypothesis(query)
        other = None
        mirrored = 0.0
        if isinstance(best, Aligned) and accepted(best):
            best, rival = settled(self.poses, query, best)
            if not rival:
                best, other = in_other_base(self.poses, query, best)
            else:
                other = InBase.of(contents.scenes[best.scene], rival)
        if not accepted(best, MIRRORED):
            mirrored = self._mirrored_support(query)
        milliseconds = 1000 * (perf_counter() - began)
        scene = contents.scenes[best.scene if best else 0]
        estimate = answer(best, scene, image.shape[:2], milliseconds, other, mirrored)
        return estimate, best

    def query(self, image: Image, camera: Camera | None) -> Query:
        """An image to be located, of the stated camera, before it is encoded."""
        scenes = self.contents.scenes
        cameras = cameras_in_scenes(camera, image, scenes)
        priors = [prior_of(camera, image, scene) for scene in scenes]
        return Query(image, self.options.patches_short_side, cameras, priors)

    def aligned(
        self, query: Query, scene: int, start: SE3, prior: IntrinsicsPrior
    ) -> Aligned | None:
        """The pose of an alignment that begins at a pose map_from_camera in one scene.

        `prior` replaces that of the image.
        """
        priors = list(query.priors)
        priors[scene] = replace(prior, scatter=priors[scene].scatter)
        query = replace(query, priors=priors)
        seen = self.poses.bank.seen(scene, start, query.cameras[scene])
        candidate = Candidate(scene, seen[: self.options.keyframes])
        return self.poses.aligned(query, candidate, start, np.zeros(INTRINSICS))

    def _best_hypothesis(self, query: Query) -> Hypothesis | None:
        """The pose with the most support, from as few attempts as it takes."""
        options = self.options
        matcher = self.poses.matcher
        first, *others = options.attempts
        best = self._tried(query, first)
        # A pose that is barely accepted may be beaten in the next attempt.
        if accepted(best, options.immediate) or not others:
            return best
        if self._inliers(best) == "few inliers":  # rotated, or of another room
            query = replace(query, encoded=matcher.upright(query))
        for attempt in others:
            if attempt.when not in ("always", self._inliers(best)):
                continue
            if attempt.scale != 1:
                query = replace(query, encoded=matcher.magnified(query, attempt.scale))
            trial = self._tried(query, attempt, thorough=True)
            best = max(best, trial, key=order)
            if accepted(best, options.immediate):
                break
        return best

    def _mirrored_support(self, query: Query) -> float:
        """Support of the mirror image, if it is more similar to keyframes."""
        mirror = self.poses.matcher.mirrored(query)
        if not mirror:
            return 0.0
        return order(self._tried(mirror, self.options.attempts[0]))[0]

    def _inliers(self, best: Hypothesis | None) -> str:
        """Whether PnP has many inliers, in the words of `Attempt.when`."""
        if not best or best.pnp_inliers < self.options.aligned_inliers:
            return "few inliers"
        return "many inliers"

    def _tried(
        self, query: Query, attempt: Attempt, thorough: bool = False
    ) -> Hypothesis | None:
        """The pose with the most support of one attempt."""
        best = None
        for candidate in self.poses.matcher.candidates(query, attempt, thorough):
            best = max(best, self.poses.hypothesis(query, candidate), key=order)
            if accepted(best, self.options.immediate):
                break
        return best
