"""The feature buffer: the frozen encoder runs once, its rows are trained on many times."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from evercal.continual.networks.descriptor import Descriptor, encode
from evercal.continual.networks.distributed import gather, processes, rank, shared_out
from evercal.continual.networks.loss import MAX_RADIUS2, Target
from evercal.features.encode import ENCODE_BATCH
from evercal.features.encoder import Encoder
from evercal.features.views import View, ViewOptions, augmented_view, frame_view
from evercal.geometry.se3 import SE3
from evercal.recordings.frame import Frame

UNBEND_STEPS = 10
SPARE_SHARE = 0.25
"""Of a GPU's memory, for all that is no feature row: weights, activations, the encoder."""


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

    def to(self, device: torch.device) -> "Rows":
        """The same on a device; copies from pinned memory to a GPU run beside other work."""
        if self.features.device == device:
            return self
        beside = device.type == "cuda"

        def moved(value: Tensor) -> Tensor:
            return value.to(device, non_blocking=beside)

        return Rows(
            moved(self.features),
            moved(self.scene),
            moved(self.descriptor),
            self.target.to(device, beside),
            moved(self.index),
            None if self.stored is None else moved(self.stored),
        )


class FeatureBuffer:
    """Feature rows of one scene, with poses and cameras in a side table (one entry per view).

    Rows that are added gather on the CPU. When they are asked for they go to `device` as a whole;
    where a GPU has no room for them they stay, and those that are drawn are copied to it.

    Args:
        scene: index of the scene in the atlas.
        atlas_from_base: where the scene's base frame lies in the atlas.
        correctable: one camera took all frames, and its distortion is not known.
        device: where rows that are drawn lie.
    """

    def __init__(
        self,
        scene: int,
        atlas_from_base: SE3,
        correctable: bool = False,
        device: torch.device | str = "cpu",
    ):
        self.scene, self.atlas_from_base = scene, atlas_from_base
        self.correctable, self.device = correctable, torch.device(device)
        self.views = 0
        self._stored: Tensor | None = None
        self._parts: list[dict[str, Tensor]] = []
        self._taken = 0
        self._merged: dict[str, Tensor] | None = None

    def add(
        self, views: Sequence[View], features: Tensor, descriptors: Tensor, keep: Tensor
    ) -> None:
        """Appends encoded views.

        Args:
            views: b views.
            features: (b, channels, h, w), on any device.
            descriptors: (b, width), on any device.
            keep: (b, cells) bool: the cells whose rows stay.
        """
        self._append(self._part(self.views, views, (features, descriptors), keep))

    def _part(
        self, first: int, views: Sequence[View], encoded: tuple[Tensor, Tensor], keep: Tensor
    ) -> dict[str, Tensor]:
        """Rows of views whose first is number `first`, by name, on the CPU."""
        features, descriptors = encoded
        rows = features.flatten(2).transpose(1, 2)
        poses = SE3.stack([self.atlas_from_base @ view.base_from_camera for view in views])
        pixels = torch.from_numpy(np.stack([view.cell_pixels for view in views]))
        number = torch.arange(first, first + len(views), dtype=torch.int32, device="cpu")
        return {
            "features": rows[keep.to(rows.device)].half().cpu(),
            "pixels": pixels[keep],
            "view": number.repeat_interleave(keep.sum(1)),
            "intrinsics": torch.from_numpy(np.stack([view.intrinsics for view in views])),
            "camera_from_atlas": torch.from_numpy(poses.inverse().matrix()[:, :3]).float(),
            "descriptors": descriptors.float().cpu(),
        }

    def _append(self, part: dict[str, Tensor]) -> None:
        self._parts.append(part)
        self.views += len(part["intrinsics"])
        self._merged = None

    def take_new(self) -> dict[str, Tensor]:
        """What was added since the last call, on the CPU, for a checkpoint; empty without any."""
        parts, self._taken = self._parts[self._taken :], len(self._parts)
        return _merge(parts) if parts else {}

    def restore(self, rows: Mapping[str, Tensor]) -> None:
        """Puts back what `take_new` gave."""
        self._append(dict(rows))
        self._taken = len(self._parts)

    @property
    def stored(self) -> Tensor | None:
        """(m, 3) points that a head once gave to the first m rows, on the buffer's device."""
        return self._stored

    @stored.setter
    def stored(self, points: Tensor | None) -> None:
        self._stored = None if points is None else points.to(self.device)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Everything in the buffer, by name: on its device, or the CPU where that has no room."""
        if self._merged is None:
            halves = self._parts[: self._taken], self._parts[self._taken :]
            self._parts, self._taken = (
                [_merge(half) for half in halves if half],
                min(self._taken, 1),
            )
            merged = _merge(self._parts)
            self._merged = _moved(merged, self.device) if _fits(merged, self.device) else merged
            if len(self._parts) == 1:
                self._parts = [self._merged]  # so that nothing is kept twice
        return self._merged

    def __len__(self) -> int:
        return len(self.tensors["features"])

    def correct_lens(self, correction: Tensor) -> None:
        """Moves rows to where an ideal pinhole would see them, now that the lens is known better.

        Args:
            correction: (5,) see `reprojection_error`, of the one camera that took all frames.
        """
        t, view = self.tensors, self.tensors["view"].long()
        focal, dx, dy, k1, k2 = correction.to(t["pixels"]).unbind()
        scale = t["intrinsics"][:, :2]
        focals, centres = (
            scale * (1 + focal),
            t["intrinsics"][:, 2:] + scale * torch.stack([dx, dy]),
        )
        bent = (t["pixels"] - centres[view]) / focals[view]
        plane = bent
        for _ in range(UNBEND_STEPS):
            radius2 = (plane * plane).sum(-1, keepdim=True).clamp(max=MAX_RADIUS2)
            plane = bent / (1 + k1 * radius2 + k2 * radius2 * radius2)
        pixels, intrinsics = plane * focals[view] + centres[view], torch.cat([focals, centres], -1)
        self._merged = {**t, "pixels": pixels, "intrinsics": intrinsics}
        self._parts, self._taken = [self._merged], 1

    def draw(self, count: int, generator: torch.Generator) -> Rows:
        """`count` random rows, with replacement."""
        # The CPU's generator draws, so that the rows are the same on every device.
        return self.rows(torch.randint(len(self), (count,), generator=generator, device="cpu"))

    def rows(self, index: Tensor) -> Rows:
        """The rows at `index` (n,), which may lie on any device."""
        t = self.tensors
        held = t["view"].device
        index = index.to(held)
        view = t["view"][index].long()
        pinned = held != self.device

        def at(name: str, where: Tensor) -> Tensor:
            return _pinned(t[name], where) if pinned else t[name][where]

        target = Target(at("pixels", index), at("intrinsics", view), at("camera_from_atlas", view))
        scene = torch.full((len(index),), self.scene, device=held)
        features, descriptors = at("features", index), at("descriptors", view)
        rows = Rows(features, scene, descriptors, target, index).to(self.device)
        if self._stored is not None:
            rows.stored = _points_at(self._stored, rows.index)
        return rows


def _points_at(stored: Tensor, index: Tensor) -> Tensor:
    """(n, 3) points at `index` (n,), NaN beyond the last."""
    points = stored[index.clamp(max=len(stored) - 1)].float()
    return torch.where((index < len(stored))[:, None], points, torch.nan)


def _merge(parts: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Parts as one, on the CPU."""
    parts = [_moved(part, torch.device("cpu")) for part in parts]
    if len(parts) == 1:
        return parts[0]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def _moved(part: Mapping[str, Tensor], device: torch.device) -> dict[str, Tensor]:
    return {name: value.to(device) for name, value in part.items()}


def _fits(part: Mapping[str, Tensor], device: torch.device) -> bool:
    """Whether a device has room for tensors besides the share that is spared for other things."""
    if device.type != "cuda":
        return True
    free, total = torch.cuda.mem_get_info(device)
    # What the allocator holds in reserve is free too.
    free += torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return sum(value.nbytes for value in part.values()) <= free - SPARE_SHARE * total


def _pinned(values: Tensor, index: Tensor) -> Tensor:
    """Rows of a tensor of the CPU in memory that a GPU can copy from by itself."""
    shape = (len(index), *values.shape[1:])
    out = torch.empty(shape, dtype=values.dtype, device="cpu", pin_memory=True)
    return torch.index_select(values, 0, index, out=out)


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
            [
                torch.full((len(p.scene), 3), none, device=p.scene.device)
                if p.stored is None
                else p.stored
                for p in parts
            ]
        )
    return Rows(cat("features"), cat("scene"), cat("descriptor"), target, cat("index"), stored)


def diffused(rows: Rows, deviation: float, generator: torch.Generator) -> Rows:
    """The rows with noise on their descriptors (GLACE's feature diffusion).

    Args:
        rows: a batch.
        deviation: of the noise on every channel; descriptors have unit length before and after.
        generator: of the device where the rows lie.
    """
    noise = torch.randn(rows.descriptor.shape, generator=generator, device=generator.device)
    descriptor = F.normalize(rows.descriptor + deviation * noise.to(rows.descriptor), dim=-1)
    return replace(rows, descriptor=descriptor)


def own_share(rows: Rows) -> Rows:
    """The rows of a batch that this process trains on, as many as every other's."""
    count = processes()
    if count == 1:
        return rows
    whole = len(rows.scene) // count * count
    return rows.part(slice(rank(), whole, count))


def encode_frames(
    buffer: FeatureBuffer,
    frames: Sequence[Frame],
    plan: "EncodePlan",
    encoder: Encoder,
    descriptor: Descriptor,
) -> Iterator[int]:
    """Encodes every frame `plan.views_per_frame` times into `buffer`; yields the views done so far.

    Views that are in the buffer already (an interrupted run) are not made again. Where processes
    work together (`networks.distributed`), each encodes its share of the batches and all get all
    rows; all must call this alike, and end with what one process alone would have.

    Pass 0 shows the frames as they are, the others show augmented views. What a view looks like and
    which of its cells stay is a function of (seed, pass, frame) alone.
    """
    todo = encode_batches(frames, plan, buffer.views)
    for batch in shared_out(todo, rank(), processes()):
        part = None
        if batch is not None:
            made = [_view(frames, number, plan, encoder.stride) for number in batch]
            views, keep = [view for view, _ in made], torch.stack([mask for _, mask in made])
            part = buffer._part(batch[0], views, encode(views, encoder, descriptor), keep)
        for one in gather(part):
            buffer._append(one)
        yield buffer.views


def encode_batches(frames: Sequence[Frame], plan: "EncodePlan", done: int = 0) -> list[list[int]]:
    """Numbers of the views that go through the encoder together: neighbours of one size.

    View n shows frame n mod len(frames) in pass n // len(frames).

    Args:
        frames: n frames.
        plan: how often each is encoded, and at which size.
        done: views that are encoded already.
    """
    batches: list[list[int]] = []
    last = None
    for number in range(done, plan.views_per_frame * len(frames)):
        small = frames[number % len(frames)].camera.short_side_resized(plan.view.short_side)
        size = small.width, small.height
        if size != last or len(batches[-1]) == ENCODE_BATCH:
            batches.append([])
        batches[-1].append(number)
        last = size
    return batches


def _view(
    frames: Sequence[Frame], number: int, plan: "EncodePlan", stride: int
) -> tuple[View, Tensor]:
    """A view by its number, and which of its cells stay (cells,)."""
    visit, position = divmod(number, len(frames))
    rng = np.random.default_rng([plan.seed, visit, position])
    if visit == 0:
        view = frame_view(frames[position], stride, plan.view)
    else:
        view = augmented_view(frames[position], stride, plan.view, rng)
    keep = rng.permutation(np.flatnonzero(view.valid))[: plan.cells if visit else None]
    mask = np.zeros(len(view.valid), bool)
    mask[keep] = True
    return view, torch.from_numpy(mask)


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
