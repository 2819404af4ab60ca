"""The training frames of a scene while its map is built: images, features, poses, cameras."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from evercal.classes import frozen
from evercal.errors import require_numbers
from evercal.features.encoder import Encoder
from evercal.features.views import working_image
from evercal.geometry import SE3, Camera
from evercal.mapping.covisibility import select_source_views
from evercal.mapping.patches import image_pyramid
from evercal.mapping.plane_sweep import USUAL_M, PosedCells, inverse_depths
from evercal.processes import cores
from evercal.recordings.frame import Frame, stated_poses
from evercal.typing import Array, Float32Array, Image, IntArray, Strings

PYRAMID_LEVELS = 3
_PYRAMIDS = 16
"""Image pyramids in memory for each thread, at most; a keyframe is aligned in 12 frames."""


@frozen
class WorkingSize:
    """Sizes that images are resized to, pixels of the shorter side."""

    cells: int = 240
    """For the encoder."""
    patches: int = 480
    """For patches; smaller images keep their size."""

    def __post_init__(self) -> None:
        """Refuse sizes below 1.

        Raises:
            InputError: No positive number of pixels.
        """
        require_numbers(self, ("cells", "patches"), 1)


class PreparedFrames:
    """Posed training frames at working size; poses and camera change during the adjustment."""

    def __init__(
        self,
        frames: Sequence[Frame],
        encoder: Encoder,
        size: WorkingSize,
    ):
        self.frames = tuple(frames)
        self.encoder = encoder
        self.size = size
        self._move(self.stated)
        self.grey: list[Image] = []
        self.cameras: list[Camera] = []
        for frame in self.frames:
            image = frame.read_image()
            short_side = min(size.patches, *image.shape[:2])
            grey, camera = working_image(image, frame.camera, short_side)
            self.grey.append(grey)
            self.cameras.append(camera)
        self.depth_scale = 1.0
        """Factor on the depths that are searched, see `plane_sweep.NEAR_M`."""
        self._features: dict[int, NDArray[np.float16]] = {}
        self._cache_pyramids()

    def without(self, excluded: IntArray) -> "PreparedFrames":
        """A copy without some frames; features of the others are not computed again."""
        index = np.setdiff1d(np.arange(len(self)), excluded)
        rest = copy(self)
        rest.frames = tuple(self.frames[i] for i in index)
        rest.grey = [self.grey[i] for i in index]
        rest.cameras = [self.cameras[i] for i in index]
        rest._move(self.poses[index])
        features = self._features
        rest._features = {
            new: features[old] for new, old in enumerate(index) if old in features
        }
        rest._cache_pyramids()
        return rest

    def in_unit(self, unit: float) -> "PreparedFrames":
        """A copy whose positions are divided by `unit`."""
        rest = copy(self)
        poses = self.stated
        scaled = SE3(poses.rotation_wxyz, poses.translation_m / unit)
        rest.frames = tuple(
            replace(frame, base_from_camera=pose)
            for frame, pose in zip(self.frames, scaled, strict=True)
        )
        rest._move(scaled)
        return rest

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def stated(self) -> SE3:
        """(n,) base_from_camera as the recording states them."""
        return stated_poses(self.frames)

    def names(self, index: IntArray) -> Strings:
        """Names of the frames of an index."""
        return tuple(self.frames[i].name for i in index)

    def cell_camera(self, i: int) -> Camera:
        """The camera of a frame at the encoder's working size."""
        return self.cameras[i].short_side_resized(self.size.cells)

    def cell_px(self, i: int) -> float:
        """Side of a cell of the feature grid, in pixels of the image that patches are cut from."""
        return self.encoder.stride * self.cameras[i].width / self.cell_camera(i).width

    def features(self, i: int) -> Float32Array:
        """(cells, channels) features of a frame, cached in half precision."""
        if i not in self._features:
            features = self.encoder.encode(self.grey[i], self.size.cells)
            self._features[i] = features.reshape(-1, features.shape[2]).astype(
                np.float16
            )
        return self._features[i].astype(np.float32)

    def posed_cells(self, i: int) -> PosedCells:
        """The encoded cells of a frame with its pose and camera."""
        camera = self.cell_camera(i)
        stride = self.encoder.stride
        return PosedCells(self.features(i), camera, self.poses[i], stride)

    def swept(self, i: int, source_views: int) -> tuple[Float32Array, list[int]]:
        """Inverse depths (cells,) of a frame by a plane sweep, and the frames it was swept over.

        At most `source_views` frames are used, selected at the usual depth of the recording.
        """
        view = self.posed_cells(i)
        guess = np.full(len(view.features), self.depth_scale * USUAL_M)
        near = self.source_views(guess, view, source_views)
        others = [self.posed_cells(j) for j in near]
        return inverse_depths(view, others, guess, self.depth_scale), near

    def source_views(
        self,
        depth_m: Array,
        view: PosedCells,
        count: int,
    ) -> list[int]:
        """Frames that show the surfaces of a view, see `select_source_views`."""
        cameras = [self.cell_camera(j) for j in range(len(self))]
        return select_source_views(
            depth_m,
            view,
            self.poses,
            cameras,
            count,
        )

    def pyramid(self, i: int) -> list[np.ndarray]:
        """Image pyramid of a frame."""
        return self._pyramid(i)

    def _cache_pyramids(self) -> None:
        grey = self.grey
        self._pyramid = lru_cache(_PYRAMIDS * cores())(
            lambda i: image_pyramid(grey[i], PYRAMID_LEVELS)
        )

    def relative(self, j: int, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) and translation (3,) of camera j from camera k."""
        base_from_j = self._matrices[j]
        base_from_k = self._matrices[k]
        rotation = base_from_j[:3, :3].T
        return rotation @ base_from_k[:3, :3], rotation @ (base_from_k - base_from_j)[
            :3, 3
        ]

    def adjust(self, poses: SE3, cameras: list[Camera] | None) -> None:
        """Replace the poses (n,), base_from_camera, and, if given, the cameras (n,)."""
        self._move(poses)
        self.cameras = cameras or self.cameras

    def _move(self, poses: SE3) -> None:
        # A pose of a batch takes long to multiply; `relative` is called for every observation.
        self.poses = poses
        self._matrices = poses.matrix()
