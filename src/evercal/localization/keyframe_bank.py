"""All keyframes of a map: retrieved by a global descriptor, decoded and encoded on demand."""

from collections import OrderedDict
from copy import copy
from functools import cached_property
from threading import Lock
from typing import NamedTuple, Self

import numpy as np

from evercal.classes import frozen_arrays
from evercal.features.encoder import Encoder
from evercal.features.views import ideal_cell_pixels
from evercal.geometry import SE3, Camera
from evercal.localization.repetition import pattern_steps
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.landmarks import project_surface
from evercal.mapping.patches import Patches, cut_patches, image_pyramid, to_level
from evercal.mapping.scene_map import MapContents
from evercal.typing import Array, Float32Array, IntArray

ALIGNED_LEVELS = 2
"""Levels of the image pyramid that landmarks are aligned in."""
_SAMPLED = 6
"""Every n-th landmark decides which keyframes see a view."""


class Shown(NamedTuple):
    """What a pose shows of a scene."""

    keyframes: IntArray
    """In the bank, those with most visible landmarks first."""
    landmarks: int
    """Visible landmarks, by a sample."""


@frozen_arrays
class MatchedCells:
    """Patches of a keyframe that an image is matched to, in the map's frame."""

    features: Float32Array
    """(cells, channels)."""
    points_m: Array
    """(cells, 3) surface points of the patches."""


@frozen_arrays
class AlignedLandmarks:
    """Landmarks of a keyframe that are searched in an image, in the map's frame."""

    surface_m: Array
    """(3, n, 3) landmarks and two surface points beside each, see `Landmarks.surface`."""
    depth_noise: Array
    """(n,) standard deviation of the landmarks' depths as a share of the depth."""
    position_m: Array
    """(3,) position of the keyframe's camera."""
    patches: tuple[Patches, ...]
    """Templates of the landmarks, one set for each pyramid level."""

    @cached_property
    def pattern(self) -> Array:
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
        depth = 1 / keyframes.inverse_depth[number].astype(float)
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
        patches = []
        for level, image in enumerate(pyramid):
            patches.append(cut_patches(image, to_level(marks.pixels, level)))
        return AlignedLandmarks(
            surface_m=pose.apply(marks.surface(keyframes.cameras[number])),
            depth_noise=marks.sigma / marks.inverse_depth,
            position_m=pose.translation_m,
            patches=tuple(patches),
        )


class KeyframeBank:
    """The keyframes of all scenes of a map; `most_loaded` stay decoded (up to 3 MB each)."""

    def __init__(self, contents: MapContents, most_loaded: int):
        self._contents = contents
        self._most = most_loaded
        self._lock = Lock()
        self._loaded: OrderedDict[int, LoadedKeyframe] = OrderedDict()
        self._sampled: dict[int, tuple[Array, IntArray]] = {}
        numbers = []
        descriptors = []
        for scene in contents.scenes:
            numbers.append(np.arange(len(scene.keyframes)))
            if scene.keyframes.descriptors is not None:
                descriptors.append(scene.keyframes.descriptors)
        counts = [len(of_scene) for of_scene in numbers]
        self.scene = np.repeat(np.arange(len(counts)), counts)
        self._number = np.concatenate(numbers)
        self._descriptors = np.concatenate(descriptors).astype(np.float32)
        self._used = np.ones(len(self.scene), bool)

    def only(self, keyframes: IntArray) -> Self:
        """The same bank with these keyframes in use; they are loaded once for both."""
        restricted = copy(self)
        vars(restricted).pop("scenes", None)
        restricted._used = np.isin(np.arange(len(self.scene)), keyframes) & self._used
        return restricted

    @cached_property
    def scenes(self) -> frozenset[int]:
        """Scenes with keyframes in use."""
        return frozenset(self.scene[self._used].tolist())

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
        of_scene = np.flatnonzero((self.scene == scene) & self._used)
        return of_scene[np.argsort(-similarity[of_scene], kind="stable")]

    def seen(self, scene: int, pose: SE3, camera: Camera) -> IntArray:
        """Rank the keyframes of a scene by their landmarks that a pose map_from_camera shows."""
        return self.shown(scene, pose, camera).keyframes

    def shown(self, scene: int, pose: SE3, camera: Camera) -> Shown:
        """The keyframes and landmarks of a scene that a pose map_from_camera shows."""
        surface_m, owner = self._sampled_landmarks(scene)
        inverse = pose.inverse()
        rotation = inverse.rotation_matrix()
        shift = inverse.translation_m
        shown = project_surface(surface_m, rotation, shift, camera).landmark
        of_scene = np.flatnonzero(self.scene == scene)
        counts = np.bincount(owner[shown], minlength=len(of_scene))
        order = of_scene[np.argsort(-counts, kind="stable")]
        return Shown(order[self._used[order]], _SAMPLED * int(counts.sum()))

    def _sampled_landmarks(self, scene: int) -> tuple[Array, IntArray]:
        """Some landmarks of a scene as for `project_surface`, and their keyframes."""
        if scene not in self._sampled:
            frames = self._contents.scenes[scene].keyframes
            surfaces = []
            for number, marks in enumerate(frames.landmarks):
                sampled = marks.take(np.arange(0, len(marks), _SAMPLED))
                surface = sampled.surface(frames.cameras[number])
                surfaces.append(frames.base_from_camera[number].apply(surface))
            counts = [surface.shape[1] for surface in surfaces]
            owner = np.repeat(range(len(surfaces)), counts)
            self._sampled[scene] = np.concatenate(surfaces, 1), owner
        return self._sampled[scene]

    def pattern(self, keyframes: IntArray) -> Array:
        """(k, 3) displacements by which a pose before the best keyframes may have slipped."""
        return self.load(int(keyframes[0])).landmarks.pattern

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
