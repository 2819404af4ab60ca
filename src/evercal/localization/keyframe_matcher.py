"""Keyframe matching: keyframes answer beside the network.

A network that has seen a cell from one side says little about it from another, while the feature
of a remembered frame still is the nearest one among thousands. So a cell of a query is also matched
to the cells of remembered frames, and the depth of such a cell, swept through all training frames
while they were there (`mapping.plane_sweep`), makes a match a point. Nothing of this is trained, so
nothing of it is forgotten; it costs two bytes a cell beside the frames that replay keeps anyway.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from evercal.features.encode import encode
from evercal.features.precision import fast_bfloat16
from evercal.features.views import View, ViewOptions, frame_view
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.mapping.plane_sweep import parabola
from evercal.mapping.scene_maps import SceneMaps

MAX_KEYFRAMES = 6
"""Keyframes that an image is matched to."""
NEAR_PX = 20.0
RETRIEVAL_STRIDE = 16
"""Scenes and keyframes are retrieved with every 16th cell of an image."""


@dataclass(frozen=True, eq=False)
class PosePrior:
    """A pose of the query that is roughly right."""

    camera: Camera
    """Of the query, at working size."""
    atlas_from_camera: SE3
    """Its pose."""

    def pairs(self, points: np.ndarray, stride: int) -> tuple[np.ndarray, np.ndarray]:
        """Cells of the query (k,) and points (k,) of (m, 3) that project to within `NEAR_PX`."""
        within = self.atlas_from_camera.inverse().apply(points)
        front = np.flatnonzero(within[:, 2] > 0.05)
        seen = (self.camera.project(within[front]) - (stride - 1) / 2) / stride
        rows, columns = self.camera.height // stride, self.camera.width // stride
        reach = NEAR_PX / stride
        inside = ((seen > -reach) & (seen < [columns - 1 + reach, rows - 1 + reach])).all(1)
        front, seen = front[inside], seen[inside]
        middle = np.rint(seen).astype(np.int64)
        off = middle - seen
        cells, which = [], []
        for step_v in range(-int(reach), int(reach) + 1):
            for step_u in range(-int(reach), int(reach) + 1):
                u, v = middle[:, 0] + step_u, middle[:, 1] + step_v
                near = (np.abs(off[:, 0] + step_u) < reach) & (np.abs(off[:, 1] + step_v) < reach)
                near &= (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
                cells.append((v * columns + u)[near])
                which.append(front[near])
        return np.concatenate(cells), np.concatenate(which)


@dataclass(frozen=True)
class Votes:
    """Which remembered cell of a scene a few cells of an image resemble most."""

    value: np.ndarray
    """(v,) how much, as whole numbers in the order of the cosines."""
    frame: np.ndarray
    """(v,) the remembered frame that it belongs to."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """An image beside the remembered frames that show most of it."""

    features: Tensor
    """(n, channels) of its cells."""
    among: np.ndarray
    """(m,) which of the remembered cells were looked at."""
    value: Tensor
    """(n, m) cosine, bfloat16 where that is fast."""

    def best(self) -> np.ndarray:
        """(n,) the most alike of `among`."""
        return self.among[_ordered(self.value).argmax(1)]

    def best_of(self, cells: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same where only pairs (k,) of a cell and of one of `among` are in question.

        Returns:
            (c,) cells with a pair that is alike at all, and (c,) the most alike to each.
        """
        value = _ordered(self.value)[cells, which].astype(np.int64)
        best = np.full(len(self.features), -1, np.int64)
        np.maximum.at(best, cells, (value << 32) | which)
        found = np.flatnonzero(best >= 0)
        return found, self.among[best[found] & 0xFFFFFFFF]


class KeyframeMatcher:
    """The keyframes of one scene, encoded, to match images to.

    Args:
        maps: with keyframes of the scene that have depths.
        scene: its index.
    """

    def __init__(self, maps: SceneMaps, scene: int):
        keyframes, cell = maps.keyframes[scene], maps.scenes[scene].cell
        assert keyframes is not None, "only keyframes can be matched"
        frames, stride = keyframes.frames(), maps.encoder.stride
        view = ViewOptions(short_side=maps.short_side)
        views = [frame_view(frame, stride, view) for frame in frames]
        self._count = np.array([len(v.valid) for v in views])
        self._frame = torch.arange(len(views)).repeat_interleave(torch.from_numpy(self._count))
        # Half the bytes, and twice the speed where the processor multiplies it.
        kind = torch.bfloat16 if fast_bfloat16() else torch.float32
        self._keys = torch.cat([_features(v, maps).to(kind) for v in views])
        grids = [(v.grey.shape[0] // stride, v.grey.shape[1] // stride) for v in views]
        self._neighbour_offsets = torch.cat([_neighbour_offsets(h, w) for h, w in grids])
        self._stride = stride
        self._pixels = torch.from_numpy(np.concatenate([v.cell_pixels for v in views]))
        self._intrinsics = torch.from_numpy(np.stack([v.intrinsics for v in views]))
        poses = cell.atlas_from_base @ keyframes.base_from_camera
        self._pose = torch.from_numpy(poses.matrix()).float()
        self._depth_m = 1 / torch.cat(keyframes.inverse_depth).float()
        every = torch.arange(len(self._pixels))
        self._points = self._points_at(every, self._pixels).double().numpy()

    @torch.inference_mode()
    def retrieve(self, features: Tensor) -> Votes:
        """What a few of (n, channels) features of an image resemble most."""
        alike = _ordered(features[::RETRIEVAL_STRIDE].to(self._keys.dtype) @ self._keys.T)
        return Votes(alike.max(1), self._frame[alike.argmax(1)].numpy())

    @torch.inference_mode()
    def match(self, features: Tensor, votes: Votes) -> Similarity:
        """How alike (n, channels) features of an image are to what is remembered.

        Args:
            features: of the image's cells.
            votes: what `retrieve` said of them.
        """
        among = self._voted_for(votes)
        keys = self._keys if len(among) == len(self._keys) else self._keys[among]
        return Similarity(features, among, features.to(keys.dtype) @ keys.T)

    @torch.inference_mode()
    def lift(
        self, found: Similarity, fallback_points: Tensor, expected: PosePrior | None = None
    ) -> Tensor:
        """Points (n, 3) in the atlas of the remembered cells that an image's cells resemble most.

        To a fraction of a cell: a parabola through the likeness of its neighbours tells where in
        the remembered frame the surface lies that the query's cell is centred on.

        Args:
            found: what `match` said.
            fallback_points: (n, 3) points for cells that nothing resembles.
            expected: where a cell shows what, roughly; remembered cells that a pose puts elsewhere
                are then out of question.
        """
        if expected is None:
            return self._resembled(found.features, torch.from_numpy(found.best()))
        pairs = expected.pairs(self._points[found.among], self._stride)
        cells, best = (torch.from_numpy(index) for index in found.best_of(*pairs))
        points = fallback_points.clone()
        points[cells] = self._resembled(found.features[cells], best)
        return points

    def _resembled(self, features: Tensor, best: Tensor) -> Tensor:
        """(n, 3) points of remembered cells (n,), moved to where they resemble features most."""
        ways = self._neighbour_offsets[best]
        around = torch.cat([best[:, None], best[:, None] + ways], 1)
        likeness = (features[:, None] * self._keys[around].float()).sum(-1)
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

    def _voted_for(self, votes: Votes) -> np.ndarray:
        """The cells of the frames that most votes are for."""
        if len(self._count) <= MAX_KEYFRAMES:
            return np.arange(len(self._keys))
        named = np.bincount(votes.frame, minlength=len(self._count))
        chosen = np.argsort(-named, kind="stable")[:MAX_KEYFRAMES]
        first = np.cumsum(self._count) - self._count
        return np.concatenate([first[i] + np.arange(int(self._count[i])) for i in chosen])


def _ordered(value: Tensor) -> np.ndarray:
    """Whole numbers in the order of the values, negative ones below all others.

    The bits of a positive float are ordered as it is; numpy finds the largest of them in a
    hundredth of the time that torch takes for bfloat16.
    """
    return value.view(torch.int16 if value.dtype == torch.bfloat16 else torch.int32).numpy()


def _features(view: View, maps: SceneMaps) -> Tensor:
    features, _ = encode([view], maps.encoder, maps.descriptor)
    return features[0].flatten(1).T


def _neighbour_offsets(rows: int, columns: int) -> Tensor:
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
