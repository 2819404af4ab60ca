"""The feature buffer: the frozen encoder runs once, then training draws rows many times."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from operator import attrgetter

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from evercal.continual.networks.descriptor import Descriptor, described
from evercal.continual.networks.loss import MAX_RADIUS2, Target
from evercal.features.encoder import Encoder
from evercal.features.views import View, ViewOptions, augmented_view, frame_view
from evercal.geometry.se3 import SE3
from evercal.recordings.frame import Frame

UNDISTORT_STEPS = 10


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
    known: Tensor | None = None
    """(n, 3) points of the atlas that are known from depths; NaN for rows without one."""

    def part(self, where: slice | Tensor) -> "Rows":
        """Return the rows of a slice, or at indices (m,)."""
        return _combined([self], lambda values: values[0][where])


_TARGET = "target.pixels", "target.intrinsics", "target.camera_from_atlas"
_tensors = attrgetter("features", "scene", "descriptor", *_TARGET)


def _combined(parts: Sequence[Rows], change: Callable[[list[Tensor]], Tensor]) -> Rows:
    columns = zip(*map(_tensors, parts), strict=True)
    features, scene, descriptor, *target = (change(list(column)) for column in columns)
    known = [part.known for part in parts if part.known is not None]
    points = change(known) if known else None
    return Rows(features, scene, descriptor, Target(*target), points)


class FeatureBuffer:
    """Feature rows of one scene, with poses and cameras in a side table (one entry per view).

    Added rows accumulate on the CPU. On first use all rows move to `device`. `scene` is an index in
    the head. With `correctable`, one camera of unknown distortion took all frames.
    """

    def __init__(
        self,
        scene: int,
        atlas_from_base: SE3,
        correctable: bool = False,
        device: torch.device | str = "cpu",
    ):
        self.scene = scene
        self.atlas_from_base = atlas_from_base
        self.correctable = correctable
        self.device = torch.device(device)
        self.views = 0
        self.known: Tensor | None = None
        """(rows, 3) known points, on the buffer's device, see `Rows.known`."""
        self._parts: list[dict[str, Tensor]] = []
        self._merged: dict[str, Tensor] | None = None

    def append(self, view: View, encoded: tuple[Tensor, Tensor], keep: Tensor) -> None:
        """Append the rows of a view that a mask (cells,) keeps.

        `encoded` are features (cells, channels) and a descriptor (width,) on any device.
        """
        features, descriptor = (values.cpu() for values in encoded)
        camera_from_atlas = (
            (self.atlas_from_base @ view.base_from_camera).inverse().matrix()[:3]
        )
        part = {
            "features": features[keep].half(),
            "pixels": torch.tensor(view.cell_pixels, device="cpu")[keep],
            "view": torch.full(
                (int(keep.sum()),), self.views, dtype=torch.int32, device="cpu"
            ),
            "intrinsics": torch.from_numpy(view.intrinsics)[None],
            "camera_from_atlas": torch.from_numpy(camera_from_atlas)[None].float(),
            "descriptors": descriptor[None].float(),
        }
        self.extend(part)

    def extend(self, part: Mapping[str, Tensor]) -> None:
        """Append rows by name, as in `tensors`."""
        self._parts.append(dict(part))
        self.views += len(part["intrinsics"])
        self._merged = None

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, on the buffer's device."""
        if self._merged is None:
            names = self._parts[0]
            self._merged = {
                name: torch.cat([part[name].cpu() for part in self._parts]).to(
                    self.device
                )
                for name in names
            }
            self._parts = [self._merged]  # one copy in memory
        return self._merged

    def __len__(self) -> int:
        return len(self.tensors["features"])

    @property
    def starts(self) -> Tensor:
        """(views + 1,) first row of every view, and the number of rows; on the CPU."""
        view = self.tensors["view"].cpu()
        return torch.searchsorted(
            view, torch.arange(self.views + 1, dtype=view.dtype, device="cpu")
        )

    def correct_lens(self, correction: Tensor) -> None:
        """Undistort the pixels and correct the intrinsics; see `reprojection_error`."""
        t = self.tensors
        view = self.tensors["view"].long()
        focal, dx, dy, k1, k2 = correction.to(t["pixels"]).unbind()
        scale = t["intrinsics"][:, :2]
        focals = scale * (1 + focal)
        centres = t["intrinsics"][:, 2:] + scale * torch.stack([dx, dy])
        distorted = (t["pixels"] - centres[view]) / focals[view]
        plane = distorted
        for _ in range(UNDISTORT_STEPS):
            radius2 = (plane * plane).sum(-1, keepdim=True).clamp(max=MAX_RADIUS2)
            plane = distorted / (1 + k1 * radius2 + k2 * radius2 * radius2)
        pixels = plane * focals[view] + centres[view]
        intrinsics = torch.cat([focals, centres], -1)
        self._merged = {**t, "pixels": pixels, "intrinsics": intrinsics}
        self._parts = [self._merged]

    def draw(self, count: int, generator: torch.Generator) -> Rows:
        """Draw `count` random rows with replacement, equal on every device."""
        return self.rows(
            torch.randint(len(self), (count,), generator=generator, device="cpu")
        )

    def rows(self, index: Tensor) -> Rows:
        """Return the rows at `index` (n,), which may be on any device."""
        t = self.tensors
        index = index.to(t["view"].device)
        view = t["view"][index].long()
        target = Target(
            t["pixels"][index], t["intrinsics"][view], t["camera_from_atlas"][view]
        )
        scene = torch.full((len(index),), self.scene, device=index.device)
        known = None if self.known is None else self.known[index].float()
        return Rows(t["features"][index], scene, t["descriptors"][view], target, known)


def join(parts: Sequence[Rows]) -> Rows:
    """Concatenate batches."""
    if len(parts) == 1:
        return parts[0]
    if any(part.known is not None for part in parts):
        nan = torch.full((1, 3), torch.nan, device=parts[0].scene.device)
        parts = [
            replace(part, known=nan.expand(len(part.scene), 3))
            if part.known is None
            else part
            for part in parts
        ]
    return _combined(parts, torch.cat)


def diffused(rows: Rows, deviation: float, generator: torch.Generator) -> Rows:
    """Add noise to unit descriptors of rows (GLACE's feature diffusion); `deviation` per channel.

    The generator is on the device of the rows.
    """
    noise = torch.randn(
        rows.descriptor.shape, generator=generator, device=generator.device
    )
    descriptor = F.normalize(
        rows.descriptor + deviation * noise.to(rows.descriptor), dim=-1
    )
    return replace(rows, descriptor=descriptor)


@dataclass(frozen=True)
class EncodePlan:
    """How a buffer is filled."""

    views_per_frame: int = 4
    """Views of every frame; the first is not augmented."""
    cells: int = 600
    """Rows taken from an augmented view; a plain view gives all rows."""
    seed: int = 0
    view: ViewOptions = field(default_factory=ViewOptions)


def encode_frames(
    buffer: FeatureBuffer,
    frames: Sequence[Frame],
    plan: EncodePlan,
    encoder: Encoder,
    descriptor: Descriptor,
) -> Iterator[int]:
    """Encode every frame `plan.views_per_frame` times; yields the number of views in the buffer.

    Pass 0 shows the frames unchanged, later passes augmented. A view and its cells depend only on
    (seed, pass, frame).
    """
    for visit, (position, frame) in product(
        range(plan.views_per_frame), enumerate(frames)
    ):
        rng = np.random.default_rng([plan.seed, visit, position])
        if visit == 0:
            view = frame_view(frame, encoder.stride, plan.view)
        else:
            view = augmented_view(frame, encoder.stride, plan.view, rng)
        some = rng.permutation(np.flatnonzero(view.valid))[
            : plan.cells if visit else None
        ]
        keep = np.zeros(len(view.valid), bool)
        keep[some] = True
        encoded = described(encoder(view.grey), descriptor)
        buffer.append(view, encoded, torch.from_numpy(keep))
        yield buffer.views
