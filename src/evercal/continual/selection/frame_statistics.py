"""Statistics of the frames of a learned scene, for selectors."""

from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from evercal.continual.networks.buffer import FeatureBuffer, Rows, random_indices
from evercal.continual.networks.head import Head
from evercal.continual.networks.loss import fixed_clamp_loss
from evercal.recordings.frame import Frame, stated_poses
from evercal.typing import Array, IntArray

RELIABLE_PX = 10.0
"""Reprojection error below which a predicted point belongs to a part, pixels."""
PARTS = 625
"""Largest number of parts of a scene: the 25 x 25 clusters of HSCNet that Buff-CS uses."""
PART_POINTS = 20_000
"""Maximum number of points from which the parts are clustered."""
GRADIENT_ROWS = 256
"""Rows of each frame from which a gradient is computed."""


class FrameStatistics:
    """n frames of one scene in recorded order; everything but the poses is computed lazily.

    `head` has learned the scene, and `rows` returns a buffer whose first n views are the plain
    views of these frames.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        head: Head,
        rows: Callable[[], FeatureBuffer],
        seed: int,
        scene: int = 0,
    ):
        poses = stated_poses(frames)
        self.positions_m = poses.translation_m
        """(n, 3) camera positions in the base frame."""
        self.quaternions_wxyz = poses.rotation_wxyz
        """(n, 4) camera orientations."""
        self._head = head
        self._rows = rows
        self._seed = seed
        self._scene = scene

    def __len__(self) -> int:
        return len(self.positions_m)

    def rng(self) -> np.random.Generator:
        """Create the generator of a selector, with the same state at every call.

        Each scene of a run has its own, so that scenes of equal length keep different frames.
        """
        return np.random.default_rng([self._seed, 31, self._scene])

    @cached_property
    def _buffer(self) -> FeatureBuffer:
        return self._rows()

    @cached_property
    def _starts(self) -> list[int]:
        return self._buffer.starts.tolist()

    def _rows_of(self, frame: int) -> Rows:
        start, end = self._starts[frame : frame + 2]
        return self._buffer.rows(torch.arange(start, end, device="cpu"))

    def _hidden(self, rows: Rows) -> Tensor:
        features = rows.features.float()
        return self._head.hidden(features, self._buffer.scene, rows.descriptor)

    def _points(self, hidden: Tensor) -> Tensor:
        return self._head.decode(hidden.float(), self._buffer.scene).points

    @torch.no_grad()
    def features(self) -> Array:
        """Compute (n, width) activations of the last hidden layer, averaged over each image."""
        pooled = [self._hidden(self._rows_of(i)).mean(0) for i in range(len(self))]
        return torch.stack(pooled).double().cpu().numpy()

    @torch.no_grad()
    def visible_parts(self) -> list[IntArray]:
        """Return the numbers of the scene's parts that each frame shows.

        Parts are at most 625 k-means cells of predicted points that reproject within 10 px. They
        replace the labels of Buff-CS, which few scenes have.
        """
        from scipy.cluster.vq import kmeans, vq

        reliable = []
        for i in range(len(self)):
            rows = self._rows_of(i)
            points = self._points(self._hidden(rows))
            _, error = fixed_clamp_loss(points, rows.target)
            reliable.append(points[error < RELIABLE_PX].double().cpu().numpy())
        points = np.concatenate(reliable)
        if not len(points):
            return [np.zeros(0, np.int64)] * len(reliable)
        rng = self.rng()
        sample = points[rng.permutation(len(points))[:PART_POINTS]]
        start = sample[rng.permutation(len(sample))[:PARTS]]
        centres, _ = kmeans(sample, start, thresh=1e-3)
        return [np.unique(vq(points, centres)[0]) for points in reliable]

    def gradients(self) -> Array:
        """Compute (n, p) gradients of each frame's loss by the scene's logits and offsets.

        Fixed centres belong to no scene; with them, gradients are by all logits and offsets.
        """
        head = self._head
        generator = torch.Generator().manual_seed(self._seed)
        shared_centres = head.options.centres != "grow"
        of_scene = shared_centres | (head.centre_scene == self._buffer.scene)
        centres = torch.nonzero(of_scene)[:, 0]
        gradients = []
        for start, end in pairwise(self._starts[: len(self) + 1]):
            drawn = random_indices(end - start, GRADIENT_ROWS, generator)
            rows = self._buffer.rows(start + drawn)
            with torch.no_grad():
                hidden = self._hidden(rows)
            loss, _ = fixed_clamp_loss(self._points(hidden), rows.target)
            by_logit, by_offset = torch.autograd.grad(
                loss.mean(), (head.logit, head.offset)
            )
            if len(by_offset) == len(by_logit):
                by_offset = by_offset[centres]
            by_logit = by_logit[centres]
            gradients.append(torch.cat([by_logit.flatten(), by_offset.flatten()]))
        return torch.stack(gradients).double().cpu().numpy()
