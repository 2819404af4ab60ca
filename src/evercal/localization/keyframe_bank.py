"""All keyframes of a store: found by a global descriptor, decoded and encoded when needed."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evercal.features.encode import encode_features
from evercal.features.precision import fast_bfloat16
from evercal.features.views import ViewOptions, plain_view
from evercal.features.vlad import vlad_for
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.patches import Patches, cut_patches, image_pyramid, to_level
from evercal.mapping.plane_sweep import PosedCells
from evercal.mapping.scene_maps import SceneMaps

ALIGNED_LEVELS = 2


@dataclass(frozen=True, eq=False)
class MatchedCells:
    """What an image is matched to; coordinates in the base frame of the scene."""

    features: Tensor
    """(cells, channels) on the encoder's device, bfloat16 where that is fast."""
    points_m: np.ndarray
    """(cells, 3) what the patches of the feature grid show."""


@dataclass(frozen=True, eq=False)
class AlignedLandmarks:
    """What is looked for in an image; coordinates in the base frame of the scene."""

    surface_m: np.ndarray
    """(3, n, 3) landmarks and two points beside each, see `Landmarks.surface`."""
    depth_noise: np.ndarray
    """(n,) standard deviation of the landmarks' depths as a share of the depth."""
    position_m: np.ndarray
    """(3,) where the keyframe was taken."""
    patches: tuple[Patches, ...]
    """Templates of the landmarks, one set for each pyramid level."""


class LoadedKeyframe:
    """A keyframe that is made ready to be matched, or to be aligned, when first asked for it.

    Few of those that are matched are ever aligned.

    Args:
        maps: whose encoder makes the features.
        keyframes: of a scene.
        number: which of them.
    """

    def __init__(self, maps: SceneMaps, keyframes: Keyframes, number: int):
        self._maps, self._keyframes, self._number = maps, keyframes, number
        self._lock = Lock()  # other threads go on with other keyframes
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
        maps, keyframes, number = self._maps, self._keyframes, self._number
        camera, pose = keyframes.cameras[number], keyframes.base_from_camera[number]
        stride, view_options = maps.encoder.stride, ViewOptions(short_side=maps.short_side)
        view = plain_view(keyframes.grey(number), camera, stride, view_options)
        features = encode_features([view], maps.encoder)[0].flatten(1).T
        small = camera.short_side_resized(maps.short_side)
        rays = PosedCells(features, small, pose, stride).rays()
        depth = 1 / keyframes.inverse_depth[number].double().numpy()
        kind = torch.bfloat16 if fast_bfloat16(features.device) else torch.float32
        points = rays * depth[:, None]
        known = np.flatnonzero(np.isfinite(points).all(1))  # a strong lens has corners without rays
        return MatchedCells(features[known].to(kind), pose.apply(points[known]))

    def _cut(self) -> AlignedLandmarks:
        keyframes, number = self._keyframes, self._number
        pose, marks = keyframes.base_from_camera[number], keyframes.landmarks[number]
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
    """The keyframes of all scenes that have a map.

    Args:
        maps: with keyframes that have descriptors.
        most_loaded: how many keyframes stay decoded in memory (up to 3 MB each).
    """

    def __init__(self, maps: SceneMaps, most_loaded: int):
        self._maps, self._most, self._lock = maps, most_loaded, Lock()
        self._loaded: OrderedDict[int, LoadedKeyframe] = OrderedDict()
        scenes, numbers, descriptors = [], [], []
        for scene, keyframes in enumerate(maps.keyframes):
            if keyframes is None or keyframes.descriptors is None:
                continue
            scenes.append(np.full(len(keyframes), scene))
            numbers.append(np.arange(len(keyframes)))
            descriptors.append(keyframes.descriptors.float())
        self.scene = np.concatenate([np.zeros(0, int), *scenes])
        self._number = np.concatenate([np.zeros(0, int), *numbers])
        self._descriptors = torch.cat(descriptors).to(maps.device) if descriptors else None

    def __len__(self) -> int:
        return len(self.scene)

    def retrieve(self, features: Tensor, scenes: Sequence[int]) -> NDArray[np.int64]:
        """The keyframes of some scenes, those whose descriptors are most alike first.

        One product of a matrix and a vector: 3 ms for 10,000 keyframes, so no index is needed.

        Args:
            features: (cells, channels) of the query, on the encoder's device.
            scenes: scenes in question.
        """
        if self._descriptors is None:
            return np.zeros(0, np.int64)
        likeness = (self._descriptors @ vlad_for(self._maps.encoder)(features)).cpu().numpy()
        order = np.argsort(-likeness, kind="stable")
        return order[np.isin(self.scene[order], scenes)]

    def load(self, index: int) -> LoadedKeyframe:
        """A keyframe of the bank, by its index."""
        with self._lock:
            if index not in self._loaded:
                self._loaded[index] = self._read(int(self.scene[index]), int(self._number[index]))
                if len(self._loaded) > self._most:
                    self._loaded.popitem(last=False)
            self._loaded.move_to_end(index)
            return self._loaded[index]

    def _read(self, scene: int, number: int) -> LoadedKeyframe:
        keyframes = self._maps.keyframes[scene]
        assert keyframes is not None, "only keyframes are in the bank"
        return LoadedKeyframe(self._maps, keyframes, number)
