"""Recall: remembered frames answer beside the network.

A network that has seen a cell from one side says little about it from another, while the feature
of a remembered frame still is the nearest one among thousands. So a cell of a query is also matched
to the cells of remembered frames, and the depth of such a cell, swept through all training frames
while they were there (`training.sweep`), makes a match a point. Nothing of this is trained, so
nothing of it is forgotten; it costs two bytes a cell beside the frames that replay keeps anyway.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from evercal.continual.candidates import Candidates
from evercal.continual.knowledge import Knowledge
from evercal.datasets.frame import Frame
from evercal.geometry.se3 import SE3
from evercal.training.buffer import encode
from evercal.training.precision import fast_bfloat16
from evercal.training.sweep import PosedCells, beside, inverse_depths, parabola
from evercal.training.views import View, ViewOptions, frame_view

OTHER_VIEWS = 12
FRAMES = 8
"""Remembered frames that an image is matched to."""
NEAR_PX = 20.0
VOTERS = 8
"""Every so many-th cell votes for them."""


def remembered_depths(
    known: Knowledge, chosen: np.ndarray, frames: Sequence[Frame], seen: Candidates
) -> tuple[Tensor, ...]:
    """Inverse depths (cells,) of each frame that is remembered, half floats.

    Args:
        known: encoder and working size.
        chosen: which of the training frames are remembered.
        frames: all training frames of a scene.
        seen: the same frames with their rows and the head that learned them.
    """
    stride = known.encoder.stride
    cameras = [frame.camera.short_side_resized(known.short_side) for frame in frames]
    poses = SE3.stack([f.base_from_camera for f in frames if f.base_from_camera is not None])

    def cells(i: int) -> PosedCells:
        return PosedCells(seen.local_features(i), cameras[i], poses[i], stride)

    depths = []
    for i in chosen.tolist():
        view, guess = cells(i), seen.depths_m(i)
        others = [cells(j) for j in beside(guess, view, poses, cameras, OTHER_VIEWS)]
        depths.append(inverse_depths(view, others, guess).half())
    return tuple(depths)


@dataclass(frozen=True, eq=False)
class Expected:
    """A pose that is roughly right."""

    pixels: Tensor
    """(n, 2) ideal-pinhole pixels of the query's cells."""
    intrinsics: Tensor
    """(4,) fx, fy, cx, cy."""
    camera_from_atlas: Tensor
    """(3, 4)."""

    @classmethod
    def from_pose(
        cls, pixels: np.ndarray, intrinsics: np.ndarray, atlas_from_camera: SE3
    ) -> "Expected":
        """From a pose in the atlas, pixels (n, 2) and (4,) intrinsics."""
        pose = atlas_from_camera.inverse().matrix()[:3]
        return cls(*(torch.tensor(part).float() for part in (pixels, intrinsics, pose)))

    def near(self, points: Tensor) -> Tensor:
        """(n, m) bool: point (m, 3) projects to within `NEAR_PX` of a cell."""
        pose = self.camera_from_atlas
        within = points @ pose[:, :3].T + pose[:, 3]
        depth = within[:, 2:].clamp(min=1e-3)
        seen = within[:, :2] / depth * self.intrinsics[:2] + self.intrinsics[2:]
        close = (self.pixels[:, None, 0] - seen[:, 0]).abs() < NEAR_PX
        close &= (self.pixels[:, None, 1] - seen[:, 1]).abs() < NEAR_PX
        return close & (within[:, 2] > 0)


@dataclass(frozen=True, eq=False)
class Likeness:
    """An image beside the remembered frames that show most of it."""

    features: Tensor
    """(n, channels) of its cells."""
    among: Tensor
    """(m,) which of the remembered cells were looked at."""
    value: Tensor
    """(n, m) cosine."""


class Recall:
    """The remembered frames of one scene, encoded, to match images to.

    Args:
        known: with a memory of the scene that has depths.
        scene: its index.
    """

    def __init__(self, known: Knowledge, scene: int):
        memory, cell = known.memories[scene], known.scenes[scene].cell
        assert memory is not None, "only what is remembered can be recalled"
        frames, stride = memory.frames(), known.encoder.stride
        view = ViewOptions(short_side=known.short_side)
        views = [frame_view(frame, stride, view) for frame in frames]
        self._count = torch.tensor([len(v.valid) for v in views])
        self._first = self._count.cumsum(0) - self._count
        self._frame = torch.arange(len(views)).repeat_interleave(self._count)
        keys = [_features(v, known) for v in views]
        # Half the bytes, and twice the speed where the processor multiplies it.
        self._keys = torch.cat(keys).to(torch.bfloat16 if fast_bfloat16() else torch.float32)
        grids = [(v.grey.shape[0] // stride, v.grey.shape[1] // stride) for v in views]
        self._ways = torch.cat([_ways(h, w) for h, w in grids])
        self._stride = stride
        self._pixels = torch.from_numpy(np.concatenate([v.cell_pixels for v in views]))
        self._intrinsics = torch.from_numpy(np.stack([v.intrinsics for v in views]))
        poses = cell.atlas_from_base @ memory.base_from_camera
        self._pose = torch.from_numpy(poses.matrix()).float()
        self._depth_m = 1 / torch.cat(memory.inverse_depth).float()
        self._points = self._points_at(torch.arange(len(self._pixels)), self._pixels)

    @torch.inference_mode()
    def look(self, features: Tensor) -> Likeness:
        """How alike (n, channels) features of an image are to what is remembered."""
        among = self._candidates(features)
        value = (features.to(self._keys.dtype) @ self._keys[among].T).float()
        return Likeness(features, among, value)

    @torch.inference_mode()
    def points(self, found: Likeness, expected: Expected | None = None) -> Tensor:
        """Points (n, 3) in the atlas of the remembered cells that an image's cells resemble most.

        To a fraction of a cell: a parabola through the likeness of its neighbours tells where in
        the remembered frame the surface lies that the query's cell is centred on.

        Args:
            found: what `look` said.
            expected: where a cell shows what, roughly; remembered cells that a pose puts elsewhere
                are then out of question.
        """
        value = found.value
        if expected is not None:
            value = value.masked_fill(~expected.near(self._points[found.among]), -2.0)
        best = found.among[value.argmax(1)]
        ways = self._ways[best]
        around = torch.cat([best[:, None], best[:, None] + ways], 1)
        likeness = (found.features[:, None] * self._keys[around].float()).sum(-1)
        middle, left, right, up, down = likeness.unbind(1)
        du = parabola(left, middle, right) * ((ways[:, 0] != 0) & (ways[:, 1] != 0))
        dv = parabola(up, middle, down) * ((ways[:, 2] != 0) & (ways[:, 3] != 0))
        return self._points_at(best, self._pixels[best] + self._stride * torch.stack([du, dv], 1))

    def _points_at(self, cells: Tensor, pixels: Tensor) -> Tensor:
        """(n, 3) where rays through pixels (n, 2) reach the depth of remembered cells (n,)."""
        frame = self._frame[cells]
        focal, centre = self._intrinsics[frame].split(2, dim=1)
        ray = torch.cat([(pixels - centre) / focal, torch.ones(len(cells), 1)], 1)
        pose = self._pose[frame]
        points = torch.einsum("nij,nj->ni", pose[:, :3, :3], ray * self._depth_m[cells][:, None])
        return points + pose[:, :3, 3]

    def _candidates(self, features: Tensor) -> Tensor:
        """Rows of the frames that most of a few cells find their likeness in."""
        if len(self._count) <= FRAMES:
            return torch.arange(len(self._keys))
        voters = features[::VOTERS].to(self._keys.dtype)
        votes = self._frame[(voters @ self._keys.T).argmax(1)]
        count = torch.bincount(votes, minlength=len(self._count))
        chosen = count.topk(FRAMES).indices
        return torch.cat([self._first[i] + torch.arange(int(self._count[i])) for i in chosen])


def _features(view: View, known: Knowledge) -> Tensor:
    features, _ = encode([view], known.encoder, known.descriptor)
    return features[0].flatten(1).T


def _ways(rows: int, columns: int) -> Tensor:
    """(cells, 4) steps to the neighbours left, right, above and below; 0 where there is none."""
    row, column = (
        i.flatten()
        for i in torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    )
    return torch.stack(
        [
            -1 * (column > 0),
            1 * (column < columns - 1),
            -columns * (row > 0),
            columns * (row < rows - 1),
        ],
        1,
    )
