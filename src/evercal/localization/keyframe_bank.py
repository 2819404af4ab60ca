"""All keyframes of a map: retrieved by a global descriptor, decoded and encoded on demand."""

from collections import OrderedDict
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import Self

import numpy as np

from evercal.features.encoder import Encoder
from evercal.features.views import ideal_cell_pixels
from evercal.geometry import SE3, Camera
from evercal.localization.repetition import pattern_steps
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.landmarks import project_surface
from evercal.mapping.patches import Patches, cut_patches, image_pyramid, to_level
from evercal.mapping.scene_map import MapContents
from evercal.typing import Float32Array, IntArray

ALIGNED_LEVELS = 2
_SAMPLED = 6
"""Every n-th landmark decides which keyframes see a view."""


@dataclass(frozen=True, eq=False)
class MatchedCells:
    """Patches of a keyframe that an image is matched to, in the map's frame."""

    features: Float32Array
    """(cells, channels)."""
    points_m: np.ndarray
    """(cells, 3) surface points of the patches."""


@dataclass(frozen=True, eq=False)
class AlignedLandmarks:
    """Landmarks of a keyframe that are searched in an image, in the map's frame."""

    surface_m: np.ndarray
    """(3, n, 3) landmarks and two surface points beside each, see `Landmarks.surface`."""
    depth_noise: np.ndarray
    """(n,) standard deviation of the landmarks' depths as a share of the depth."""
    position_m: np.ndarray
    """(3,) position of the keyframe's camera."""
    patches: tuple[Patches, ...]
    """Templates of the landmarks, one set for each pyramid level."""

    @cached_property
    def pattern(self) -> np.ndarray:
        """(k, 3) displacements between landmarks that look alike, see `pattern_steps`."""
        return pattern_steps(
            self.surface_m[0], self.patches[1].templates[:, 2], self.position_m
        )


class LoadedKeyframe:
    """A keyframe that is prepared for matching, or for alignment, on first use.

    Few of the keyframes that are matched are ever aligned.
    """

    def __init__(self, contents: MapContents, keyframes: Keyframes, number: int):
        self._contents = contents
        self._keyframes = keyframes
        self._number = number
        # One lock per keyframe, so that threads can load different ones.
        self._lock = Lock()
        self._cells: MatchedCells | None = None
        self._landmarks: AlignedLandmarks | None = None

    @property
    def cells(self) -> MatchedCells:
        """Its patches, encoded."""
        with self._lock:
            self._cells = self._cells or self._encoded()
            return self._cells

    @property
    def landmarks(self) -> AlignedLandmarks:
        """Its landmarks with their templates."""
        with self._lock:
            self._landmarks = self._landmarks or self._cut()
            return self._landmarks

    def _encoded(self) -> MatchedCells:
        contents = self._contents
        keyframes = self._keyframes
        number = self._number
        camera = keyframes.cameras[number]
        pose = keyframes.base_from_camera[number]
        grey = keyframes.grey(number)
        encoder = contents.encoder
        features = encoder.encode(grey, contents.short_side).reshape(-1, encoder.width)
        small = camera.short_side_resized(contents.short_side)
        rays = small.pinhole.unproject(ideal_cell_pixels(small, encoder.stride))
        depth = 1 / keyframes.inverse_depth[number].astype(np.float64)
        points = rays * depth[:, None]
        # Corners of a strongly distorted image have no rays.
        valid = np.flatnonzero(np.isfinite(points).all(1))
        return MatchedCells(features[valid], pose.apply(points[valid]))

    def _cut(self) -> AlignedLandmarks:
        keyframes = self._keyframes
        number = self._number
        pose = keyframes.base_from_camera[number]
        marks = keyframes.landmarks[number]
        pyramid = image_pyramid(keyframes.grey(number), ALIGNED_LEVELS)
        return AlignedLandmarks(
            pose.apply(marks.surface(keyframes.cameras[number])),
            marks.sigma / marks.inverse_depth,
            pose.translation_m,
            tuple(
                cut_patches(image, to_level(marks.pixels, level))
                for level, image in enumerate(pyramid)
            ),
        )


class KeyframeBank:
    """The keyframes of all scenes of a map; `most_loaded` stay decoded (up to 3 MB each)."""

    def __init__(self, contents: MapContents, most_loaded: int):
        self._contents = contents
        self._most = most_loaded
        self._lock = Lock()
        self._loaded: OrderedDict[int, LoadedKeyframe] = OrderedDict()
        self._sampled: dict[int, tuple[np.ndarray, IntArray]] = {}
        keyframes = [scene.keyframes for scene in contents.scenes]
        counts = [len(k) for k in keyframes]
        self.scene = np.repeat(np.arange(len(counts)), counts)
        self._number = np.concatenate([np.arange(count) for count in counts])
        descriptors = [k.descriptors for k in keyframes if k.descriptors is not None]
        self._descriptors = np.concatenate(descriptors).astype(np.float32)
        self._used = np.ones(len(self.scene), bool)

    def only(self, keyframes: IntArray) -> Self:
        """The same bank with these keyframes in use; they are loaded once for both."""
        part = copy(self)
        part._used = np.isin(np.arange(len(self.scene)), keyframes)
        return part

    @property
    def encoder(self) -> Encoder:
        """The encoder of the map."""
        return self._contents.encoder

    def similarity(self, *descriptors: Float32Array) -> Float32Array:
        """(images, keyframes) similarity to the descriptors (width,) of images.

        Keyframes that are not in use get -inf. With the ranking it takes 24 ms for 100,000
        keyframes and 81 ms for four images, so maps of a site need no index (docs/scale.md).
        """
        similarity = (self._descriptors @ np.stack(descriptors, 1)).T
        similarity[:, ~self._used] = -np.inf
        return similarity

    def ranked(self, similarity: Float32Array, most: int) -> IntArray:
        """The `most` keyframes in use with the greatest similarity (keyframes,), best first."""
        first = min(most, len(similarity)) - 1
        best = np.flatnonzero(similarity >= -np.partition(-similarity, first)[first])
        order = best[np.argsort(-similarity[best], kind="stable")][:most]
        return order[self._used[order]]

    def ranked_of(self, scene: int, similarity: Float32Array) -> IntArray:
        """The keyframes of a scene in use, best first."""
        own = np.flatnonzero((self.scene == scene) & self._used)
        return own[np.argsort(-similarity[own], kind="stable")]

    def seen(self, scene: int, pose: SE3, camera: Camera) -> IntArray:
        """Rank the keyframes of a scene by their landmarks that a pose map_from_camera shows."""
        if scene not in self._sampled:
            frames = self._contents.scenes[scene].keyframes
            parts = [
                pose.apply(
                    marks.take(np.arange(0, len(marks), _SAMPLED)).surface(camera)
                )
                for pose, marks, camera in zip(
                    frames.base_from_camera,
                    frames.landmarks,
                    frames.cameras,
                    strict=True,
                )
            ]
            counts = [part.shape[1] for part in parts]
            self._sampled[scene] = (
                np.concatenate(parts, 1),
                np.repeat(range(len(parts)), counts),
            )
        surface_m, owner = self._sampled[scene]
        inverse = pose.inverse()
        rotation = inverse.rotation_matrix()
        shift = inverse.translation_m
        shown = project_surface(surface_m, rotation, shift, camera).landmark
        own = np.flatnonzero(self.scene == scene)
        order = own[
            np.argsort(-np.bincount(owner[shown], minlength=len(own)), kind="stable")
        ]
        return order[self._used[order]]

    def pattern(self, keyframes: IntArray) -> np.ndarray:
        """(k, 3) displacements by which a pose before the best keyframes may have slipped."""
        return np.concatenate(
            [self.load(int(k)).landmarks.pattern for k in keyframes[:1]]
        )

    def load(self, index: int) -> LoadedKeyframe:
        """A keyframe of the bank, by its index."""
        with self._lock:
            if index not in self._loaded:
                keyframes = self._contents.scenes[self.scene[index]].keyframes
                number = int(self._number[index])
                self._loaded[index] = LoadedKeyframe(self._contents, keyframes, number)
                if len(self._loaded) > self._most:
                    self._loaded.popitem(last=False)
            self._loaded.move_to_end(index)
            return self._loaded[index]
