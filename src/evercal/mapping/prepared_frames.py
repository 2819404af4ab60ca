"""The training frames of a scene while its map is built: images, features, poses, lens."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from evercal.features.encode import encode_features
from evercal.features.encoder import Encoder
from evercal.features.views import View, ViewOptions, plain_view, working_image
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.mapping.patches import image_pyramid
from evercal.mapping.plane_sweep import PosedCells
from evercal.recordings.frame import Frame, stated_poses

PYRAMID_LEVELS = 3
_PYRAMIDS = 128


@dataclass(frozen=True)
class WorkingSize:
    """Sizes that images are brought to, pixels of the shorter side."""

    cells: int = 240
    """For the encoder."""
    patches: int = 480
    """For patches, at most: smaller images stay as they are."""


class PreparedFrames:
    """Posed training frames at working size; poses and lens change while they are adjusted.

    Args:
        frames: posed frames of one scene.
        encoder: frozen local encoder.
        size: working sizes.
    """

    def __init__(self, frames: Sequence[Frame], encoder: Encoder, size: WorkingSize):
        self.frames, self.encoder, self.size = tuple(frames), encoder, size
        self.stated = stated_poses(self.frames)
        self._place(self.stated)
        self.grey: list[NDArray[np.uint8]] = []
        self.cameras: list[Camera] = []
        for frame in self.frames:
            image = frame.read_image()
            short = min(size.patches, *image.shape[:2])
            grey, camera = working_image(image, frame.camera, short)
            self.grey.append(grey)
            self.cameras.append(camera)
        self.depth_scale = 1.0
        """Of the depths that are looked for, see `plane_sweep.NEAR_M`."""
        self._features: dict[int, Tensor] = {}
        self._pyramids: OrderedDict[int, list[np.ndarray]] = OrderedDict()
        self._lock = Lock()

    def without(self, left_out: NDArray[np.int64]) -> "PreparedFrames":
        """The recording less some frames; what was computed for the others stays."""
        keep = [i for i in range(len(self)) if i not in set(left_out.tolist())]
        rest = PreparedFrames.__new__(PreparedFrames)
        rest.frames, rest.encoder, rest.size = (
            tuple(self.frames[i] for i in keep),
            self.encoder,
            self.size,
        )
        rest.depth_scale = self.depth_scale
        rest.stated = self.stated[np.array(keep)]
        rest._place(self.poses[np.array(keep)])
        rest.grey, rest.cameras = [self.grey[i] for i in keep], [self.cameras[i] for i in keep]
        known = self._features
        rest._features = {new: known[i] for new, i in enumerate(keep) if i in known}
        rest._pyramids, rest._lock = OrderedDict(), Lock()
        return rest

    def __len__(self) -> int:
        return len(self.frames)

    def cell_camera(self, i: int) -> Camera:
        """The camera of a frame at the encoder's working size."""
        return self.cameras[i].short_side_resized(self.size.cells)

    def cell_px(self, i: int) -> float:
        """Side of a patch of the feature grid, in pixels of the image that patches are cut from."""
        return self.encoder.stride * self.cameras[i].width / self.cell_camera(i).width

    def view(self, i: int) -> View:
        """What the encoder sees of a frame."""
        options = ViewOptions(short_side=self.size.cells)
        return plain_view(self.grey[i], self.cameras[i], self.encoder.stride, options)

    def features(self, i: int) -> Tensor:
        """(cells, channels) features of a frame; kept in half precision, on the CPU."""
        if i not in self._features:
            features = encode_features([self.view(i)], self.encoder)
            self._features[i] = features[0].flatten(1).T.half().cpu()
        return self._features[i].float()

    def posed_cells(self, i: int) -> PosedCells:
        """The encoded cells of a frame with its pose and camera."""
        camera, stride = self.cell_camera(i), self.encoder.stride
        return PosedCells(self.features(i), camera, self.poses[i], stride)

    def pyramid(self, i: int) -> list[np.ndarray]:
        """Image pyramid of a frame; the last ones used stay in memory."""
        with self._lock:
            if i in self._pyramids:
                self._pyramids.move_to_end(i)
                return self._pyramids[i]
        pyramid = image_pyramid(self.grey[i], PYRAMID_LEVELS)
        with self._lock:
            self._pyramids[i] = pyramid
            if len(self._pyramids) > _PYRAMIDS:
                self._pyramids.popitem(last=False)
        return pyramid

    def relative(self, j: int, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) and translation (3,) of camera j from camera k."""
        turn = self.rotation[j].T
        return turn @ self.rotation[k], turn @ (self.translation_m[k] - self.translation_m[j])

    def adjust(self, poses: SE3, camera: Camera | None) -> None:
        """Takes over adjusted poses (n,) and, where all frames share one, an adjusted camera."""
        self._place(poses)
        if camera is not None:
            self.cameras = [camera] * len(self)

    def _place(self, poses: SE3) -> None:
        """Frames are at `poses` (n,), base_from_camera, from now on."""
        self.poses, self.rotation = poses, poses.rotation_matrix()
        self.translation_m = poses.translation_m
