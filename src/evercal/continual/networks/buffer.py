"""The feature buffer: the frozen encoder runs once, then training draws rows many times."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from evercal.classes import frozen
from evercal.continual.networks.descriptor import Descriptor
from evercal.continual.networks.feature_cache import row_encoder
from evercal.continual.networks.loss import Target
from evercal.errors import require_numbers
from evercal.features.encoder import Encoder
from evercal.features.views import View, ViewOptions, augmented_view, frame_view
from evercal.geometry.se3 import SE3
from evercal.recordings.frame import Frame


@dataclass
class Rows:
    """A batch of feature rows with their observations."""

    features: Tensor
    """(n, channels)."""
    scene: Tensor
    """(n,) scene index."""
    descriptor: Tensor
    """(n, width) descriptor of each row's image."""
    target: Target
    known: Tensor
    """(n, 3) points of the atlas that are known from depths; NaN for rows without one."""

    def part(self, where: slice | Tensor) -> "Rows":
        """Return the rows of a slice, or at indices (m,)."""
        return _combined([self], lambda values: values[0][where])


def _combined(
    batches: Sequence[Rows], change: Callable[[list[Tensor]], Tensor]
) -> Rows:
    """Change every column of batches."""

    def changed(name: str) -> Tensor:
        return change(list(map(attrgetter(name), batches)))

    return Rows(
        features=changed("features"),
        scene=changed("scene"),
        descriptor=changed("descriptor"),
        target=Target(
            pixels=changed("target.pixels"),
            intrinsics=changed("target.intrinsics"),
            camera_from_atlas=changed("target.camera_from_atlas"),
        ),
        known=changed("known"),
    )


_OF_ROWS = ("features", "pixels", "view")
"""Columns with an entry for each row; the others have one for each view."""


class FeatureBuffer:
    """Feature rows of one scene, with poses and cameras in a side table (one entry per view).

    Added rows accumulate on the CPU. On first use all rows move to `device`. `scene` is an index in
    the head.
    """

    def __init__(
        self,
        scene: int,
        atlas_from_base: SE3,
        device: torch.device | str = "cpu",
    ):
        self.scene = scene
        self.atlas_from_base = atlas_from_base
        self.device = torch.device(device)
        self.views = 0
        self.known = torch.full((1, 3), torch.nan, device=self.device)
        """(rows, 3) known points on the buffer's device, or (1, 3) for all; see `Rows.known`."""
        self.planned = 0
        """Rows for which memory is reserved at once, so that no second copy is needed."""
        self._columns: dict[str, tuple[Tensor, int]] = {}
        """Columns and the entries of each that are in use."""

    def append(self, view: View, encoded: tuple[Tensor, Tensor], keep: Tensor) -> None:
        """Append the rows of a view: of the cells that a mask (cells,) keeps.

        `encoded` are their features (rows, channels) and the descriptor (width,) of the view.
        """
        features, descriptor = encoded
        atlas_from_camera = self.atlas_from_base @ view.base_from_camera
        camera_from_atlas = torch.from_numpy(atlas_from_camera.inverse().matrix()[:3])
        count = int(keep.sum())
        part = {
            "features": features.half(),
            "pixels": torch.tensor(view.cell_pixels, device="cpu")[keep],
            "view": torch.full((count,), self.views, dtype=torch.int32, device="cpu"),
            "intrinsics": torch.from_numpy(view.intrinsics)[None],
            "camera_from_atlas": camera_from_atlas[None].float(),
            "descriptors": descriptor[None].float(),
        }
        self.extend(part)

    def extend(self, part: Mapping[str, Tensor]) -> None:
        """Append rows by name, as in `tensors`."""
        self.views += len(part["intrinsics"])
        for name, values in part.items():
            column, used = self._columns.get(name, (values[:0], 0))
            end = used + len(values)
            if end > len(column):
                size = 2 * end
                if name in _OF_ROWS:
                    size = max(size, self.planned)
                longer = values.new_empty(size, *values.shape[1:])
                longer[:used] = column[:used]
                column = longer
            column[used:end] = values
            self._columns[name] = column, end

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, on the buffer's device."""
        tensors = {}
        for name, (column, used) in self._columns.items():
            tensors[name] = column[:used].to(self.device)
            self._columns[name] = tensors[name], used
        return tensors

    def __len__(self) -> int:
        return self._columns["features"][1]

    @property
    def starts(self) -> Tensor:
        """(views + 1,) first row of every view, and the number of rows; on the CPU."""
        view = self.tensors["view"].cpu()
        numbers = torch.arange(self.views + 1, dtype=view.dtype, device="cpu")
        return torch.searchsorted(view, numbers)

    def draw(self, count: int, generator: Generator) -> Rows:
        """Draw `count` random rows with replacement, equal on every device."""
        return self.rows(random_indices(len(self), count, generator))

    def rows(self, index: Tensor) -> Rows:
        """Return the rows at `index` (n,), which may be on any device."""
        tensors = self.tensors
        index = index.to(tensors["view"].device)
        view = tensors["view"][index].long()
        return Rows(
            features=tensors["features"][index],
            scene=torch.full((len(index),), self.scene, device=index.device),
            descriptor=tensors["descriptors"][view],
            target=Target(
                pixels=tensors["pixels"][index],
                intrinsics=tensors["intrinsics"][view],
                camera_from_atlas=tensors["camera_from_atlas"][view],
            ),
            known=self.known.expand(len(self), 3)[index],
        )


def random_indices(count: int, size: int, generator: Generator) -> Tensor:
    """Draw indices (size,) below `count` with replacement, equal on every device."""
    return torch.randint(count, (size,), generator=generator, device="cpu")


def join(batches: Sequence[Rows]) -> Rows:
    """Concatenate batches."""
    if len(batches) == 1:
        return batches[0]
    return _combined(batches, torch.cat)


def diffused(rows: Rows, deviation: float, generator: Generator) -> Rows:
    """Add noise to unit descriptors of rows (GLACE's feature diffusion); `deviation` per channel.

    The generator is on the device of the rows.
    """
    descriptor = rows.descriptor
    noise = torch.randn(descriptor.shape, generator=generator, device=generator.device)
    noisy = descriptor + deviation * noise.to(descriptor)
    return replace(rows, descriptor=F.normalize(noisy, dim=-1))


@frozen
class EncodePlan:
    """How a buffer is filled."""

    views_per_frame: int = 4
    """Views of every frame; the first is not augmented."""
    cells: int = 600
    """Rows taken from an augmented view; a plain view gives all rows, unless `most_rows` is met."""
    most_rows: int = 0
    """Rows of a training, at most, but one of every frame; 0 for any number."""
    thinned: bool = False
    """Whether a plain view gives `cells` rows, too."""
    seed: int = 0
    """Seed of augmentations and of the cells that are taken."""
    view: ViewOptions = field(default_factory=ViewOptions)
    """Size and augmentation of the views."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_numbers(self, ("views_per_frame", "cells"), 1)

    def rows(self, frames: Sequence[Frame], stride: int) -> int:
        """Rows of frames, at most."""
        plain = 0
        for frame in frames:
            small = frame.camera.short_side_resized(self.view.short_side)
            grid = (small.height // stride) * (small.width // stride)
            plain += min(grid, self.cells) if self.thinned else grid
        return plain + (self.views_per_frame - 1) * self.cells * len(frames)

    def limited(self, frames: Sequence[Frame], stride: int) -> "EncodePlan":
        """The plan for all frames of a training: fewer views, and equal numbers of rows of each."""
        if not self.most_rows or self.rows(frames, stride) <= self.most_rows:
            return self
        each = max(1, self.most_rows // len(frames))
        views = min(self.views_per_frame, max(1, each // self.cells))
        return replace(self, views_per_frame=views, cells=each // views, thinned=True)


def encode_frames(
    buffer: FeatureBuffer,
    frames: Sequence[Frame],
    plan: EncodePlan,
    encoder: Encoder,
    descriptor: Descriptor,
    cache: Path | None = None,
) -> Iterator[int]:
    """Encode every frame `plan.views_per_frame` times; yields the number of views in the buffer.

    Pass 0 shows the frames unchanged, later passes augmented. A view and its cells depend only on
    (seed, pass, frame). Rows that are in the folder `cache` are not encoded again.
    """
    stride = encoder.stride
    encoded = row_encoder(encoder, descriptor, cache)
    buffer.planned = plan.rows(frames, stride)
    for visit in range(plan.views_per_frame):
        for position, frame in enumerate(frames):
            rng = np.random.default_rng([plan.seed, visit, position])
            if visit == 0:
                view = frame_view(frame, stride, plan.view)
            else:
                view = augmented_view(frame, stride, plan.view, rng)
            keep = view.valid
            if visit > 0 or plan.thinned:
                valid = rng.permutation(np.flatnonzero(keep))
                keep = np.zeros(len(keep), bool)
                keep[valid[: plan.cells]] = True
            buffer.append(view, encoded(view.grey, keep), torch.from_numpy(keep))
            yield buffer.views
