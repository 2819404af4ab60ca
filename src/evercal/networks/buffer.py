"""The feature buffer: the frozen encoder runs once, its rows are trained on many times."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from evercal.datasets.frame import Frame
from evercal.features.descriptor import Descriptor
from evercal.features.encode import ENCODE_BATCH, encode
from evercal.features.encoder import Encoder
from evercal.features.views import View, ViewOptions, augmented_view, frame_view
from evercal.geometry.se3 import SE3
from evercal.networks.loss import Target


@dataclass
class Rows:
    """A batch of feature rows with all that a loss needs."""

    features: Tensor
    """(n, channels)."""
    scene: Tensor
    """(n,) scene index."""
    descriptor: Tensor
    """(n, width) descriptor of each row's image."""
    target: Target
    """Where each row must project to."""
    index: Tensor
    """(n,) position in the buffer, for what is stored beside it."""
    stored: Tensor | None = None
    """(n, 3) points that a head once gave to these rows, NaN where none were kept."""

    def part(self, where: slice | Tensor) -> "Rows":
        """The rows of a slice, or at an index (m,)."""
        t = self.target
        target = Target(t.pixels[where], t.intrinsics[where], t.camera_from_atlas[where])
        return Rows(
            self.features[where],
            self.scene[where],
            self.descriptor[where],
            target,
            self.index[where],
            None if self.stored is None else self.stored[where],
        )


class FeatureBuffer:
    """Feature rows of one scene, with poses and cameras in a side table (one entry per view).

    Args:
        scene: index of the scene in the atlas.
        atlas_from_base: where the scene's base frame lies in the atlas.
        correctable: one camera took all frames, and its distortion is not known.
    """

    def __init__(self, scene: int, atlas_from_base: SE3, correctable: bool = False):
        self.scene, self.atlas_from_base = scene, atlas_from_base
        self.correctable = correctable
        self.views = 0
        self.stored: Tensor | None = None
        """(m, 3) points that a head once gave to the first m rows."""
        self._parts: list[dict[str, Tensor]] = []
        self._taken = 0
        self._merged: dict[str, Tensor] | None = None

    def add(
        self, views: Sequence[View], features: Tensor, descriptors: Tensor, keep: Tensor
    ) -> None:
        """Appends encoded views.

        Args:
            views: b views.
            features: (b, channels, h, w).
            descriptors: (b, width).
            keep: (b, cells) bool: the cells whose rows stay.
        """
        rows = features.flatten(2).transpose(1, 2)
        poses = SE3.stack([self.atlas_from_base @ view.base_from_camera for view in views])
        pixels = torch.from_numpy(np.stack([view.cell_pixels for view in views]))
        number = torch.arange(self.views, self.views + len(views), dtype=torch.int32)
        self._append(
            {
                "features": rows[keep].half(),
                "pixels": pixels[keep],
                "view": number.repeat_interleave(keep.sum(1)),
                "intrinsics": torch.from_numpy(np.stack([view.intrinsics for view in views])),
                "camera_from_atlas": torch.from_numpy(poses.inverse().matrix()[:, :3]).float(),
                "descriptors": descriptors.float(),
            }
        )

    def _append(self, part: dict[str, Tensor]) -> None:
        self._parts.append(part)
        self.views += len(part["intrinsics"])
        self._merged = None

    def take_new(self) -> dict[str, Tensor]:
        """Everything added since the last call, for a checkpoint; empty when there is nothing."""
        parts, self._taken = self._parts[self._taken :], len(self._parts)
        return _merge(parts) if parts else {}

    def restore(self, rows: Mapping[str, Tensor]) -> None:
        """Puts back what `take_new` gave."""
        self._append(dict(rows))
        self._taken = len(self._parts)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Everything in the buffer, by name."""
        if self._merged is None:
            halves = self._parts[: self._taken], self._parts[self._taken :]
            self._parts, self._taken = (
                [_merge(half) for half in halves if half],
                min(self._taken, 1),
            )
            self._merged = _merge(self._parts)
        return self._merged

    def __len__(self) -> int:
        return len(self.tensors["features"])

    def draw(self, count: int, generator: torch.Generator) -> Rows:
        """`count` random rows, with replacement."""
        return self.rows(torch.randint(len(self), (count,), generator=generator))

    def rows(self, index: Tensor) -> Rows:
        """The rows at `index` (n,)."""
        t = self.tensors
        view = t["view"][index].long()
        target = Target(t["pixels"][index], t["intrinsics"][view], t["camera_from_atlas"][view])
        scene = torch.full((len(index),), self.scene)
        stored = None
        if self.stored is not None:
            kept = index < len(self.stored)
            stored = self.stored[index.clamp(max=len(self.stored) - 1)].float()
            stored = torch.where(kept[:, None], stored, torch.nan)
        return Rows(t["features"][index], scene, t["descriptors"][view], target, index, stored)


def _merge(parts: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    if len(parts) == 1:
        return parts[0]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def join(parts: Sequence[Rows]) -> Rows:
    """Several batches as one."""
    if len(parts) == 1:
        return parts[0]

    def cat(name: str) -> Tensor:
        return torch.cat([getattr(part, name) for part in parts])

    targets = [part.target for part in parts]
    target = Target(
        torch.cat([t.pixels for t in targets]),
        torch.cat([t.intrinsics for t in targets]),
        torch.cat([t.camera_from_atlas for t in targets]),
    )
    stored = None
    if any(part.stored is not None for part in parts):
        none = torch.nan
        stored = torch.cat(
            [torch.full((len(p.scene), 3), none) if p.stored is None else p.stored for p in parts]
        )
    return Rows(cat("features"), cat("scene"), cat("descriptor"), target, cat("index"), stored)


def encode_frames(
    buffer: FeatureBuffer,
    frames: Sequence[Frame],
    plan: "EncodePlan",
    encoder: Encoder,
    descriptor: Descriptor,
) -> Iterator[int]:
    """Encodes every frame `plan.views_per_frame` times into `buffer`; yields the views done so far.

    Views that are in the buffer already (an interrupted run) are not made again.

    Pass 0 shows the frames as they are, the others show augmented views. What a view looks like and
    which of its cells stay is a function of (seed, pass, frame) alone.
    """
    pending: list[tuple[View, Tensor]] = []
    visits = [(number, i) for number in range(plan.views_per_frame) for i in range(len(frames))]
    for number, position in visits[buffer.views :]:
        rng = np.random.default_rng([plan.seed, number, position])
        frame = frames[position]
        if number == 0:
            view = frame_view(frame, encoder.stride, plan.view)
        else:
            view = augmented_view(frame, encoder.stride, plan.view, rng)
        if pending and pending[0][0].grey.shape != view.grey.shape:
            yield _flush(buffer, pending, encoder, descriptor)
        keep = rng.permutation(np.flatnonzero(view.valid))[: plan.cells if number else None]
        mask = torch.zeros(len(view.valid), dtype=torch.bool)
        mask[torch.from_numpy(keep)] = True
        pending.append((view, mask))
        if len(pending) == ENCODE_BATCH:
            yield _flush(buffer, pending, encoder, descriptor)
    if pending:
        yield _flush(buffer, pending, encoder, descriptor)


@dataclass(frozen=True)
class EncodePlan:
    """How a buffer is filled."""

    views_per_frame: int = 4
    """Visits of every frame; the first without augmentation."""
    cells: int = 600
    """Rows kept from an augmented view; a plain view keeps all."""
    seed: int = 0
    """Of views and cells."""
    view: ViewOptions = field(default_factory=ViewOptions)
    """Working size and augmentation."""


def _flush(
    buffer: FeatureBuffer,
    pending: list[tuple[View, Tensor]],
    encoder: Encoder,
    descriptor: Descriptor,
) -> int:
    views = [view for view, _ in pending]
    features, descriptors = encode(views, encoder, descriptor)
    buffer.add(views, features, descriptors, torch.stack([keep for _, keep in pending]))
    pending.clear()
    return buffer.views
