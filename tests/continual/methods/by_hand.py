"""Rows, outputs and scenes for calculations by hand."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from evercal.continual.methods.method import MethodState, StageStart
from evercal.continual.methods.penalties import Penalty
from evercal.continual.networks.buffer import FeatureBuffer, Rows
from evercal.continual.networks.head import Head, HeadOptions, HeadOutput, fresh_head
from evercal.continual.networks.loss import Target
from evercal.geometry import SE3

from ..draws import seeded

Cost = Callable[[HeadOutput, Rows], Tensor]
DEPTH_M = 2.0
FOCAL_PX = 100.0


def rows(count: int, scene: int = 0) -> Rows:
    """Create rows of a camera at the origin; the target is always the image centre."""
    target = Target(
        torch.full((count, 2), 50.0),
        torch.tensor([FOCAL_PX, FOCAL_PX, 50.0, 50.0]).repeat(count, 1),
        torch.eye(4)[:3].repeat(count, 1, 1),
    )
    which = torch.full((count,), scene)
    known = torch.full((count, 3), torch.nan)
    return Rows(torch.zeros(count, 1), which, torch.zeros(count, 1), target, known)


def off_by(pixels: float) -> list[float]:
    """Return a point that projects `pixels` to the right of its target."""
    return [pixels / FOCAL_PX * DEPTH_M, 0.0, DEPTH_M]


def head_output(
    points: list[list[float]], hidden: list[list[float]] | None = None
) -> HeadOutput:
    """Create a head's output with given points (camera frame, metres)."""
    zero = torch.zeros(len(points), 2)
    return HeadOutput(
        zero,
        torch.zeros(len(points), 1, 3),
        torch.tensor(points, requires_grad=True),
        torch.tensor(hidden or zero.tolist()),
    )


def wave_buffer(
    scene: int, views: int = 4, shift_px: float = 0.0, few: int = 0
) -> FeatureBuffer:
    """Points in front of a camera; their features are waves of them, the same in every scene.

    So two scenes whose pixels differ by `shift_px` contradict one another. With `few`, a view shows
    so many different points only.
    """
    generator = seeded(100)
    points = torch.randn(50 * views, 3, generator=generator) + torch.tensor([0.0, 0, 4])
    points[:, 2].clamp_(min=2.0)
    if few:
        points = points[:few].repeat(len(points) // few + 1, 1)[: len(points)]
    buffer = FeatureBuffer(scene, SE3.identity())
    buffer.extend(
        {
            "features": normalize(
                torch.cat([points.sin(), points.cos(), points], 1)
            ).half(),
            "pixels": 100 * points[:, :2] / points[:, 2:]
            + 50
            + torch.tensor([shift_px, 0.0]),
            "view": torch.arange(views, dtype=torch.int32).repeat_interleave(50),
            "intrinsics": torch.tensor([[100.0, 100, 50, 50]] * views),
            "camera_from_atlas": torch.eye(4)[None, :3].repeat(views, 1, 1),
            "descriptors": normalize(torch.ones(views, 4), dim=-1),
        }
    )
    return buffer


def wave_head(scenes: int, options: HeadOptions | None = None) -> Head:
    """Create a head for scenes of `wave_buffer`."""
    options = options or HeadOptions(width=16, blocks=1, whiten=False)
    head = fresh_head(9, 4, options, seed=0)
    for scene in range(scenes):
        head.grow(torch.tensor([[0.3, 0.0, 4.0], [-0.3, 0.2, 3.5]]), seed=scene)
    return head


@dataclass(frozen=True)
class Given(Penalty):
    """A given loss of the output for replayed rows."""

    loss: Cost
    needs_teacher = False

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput, rows: Rows, tau_px: float
    ) -> Tensor:
        """Compute the loss."""
        assert teacher is student
        return self.loss(student, rows)


def stage_start(
    head: Head,
    memories: list[FeatureBuffer],
    *,
    teacher: Head | None = None,
    states: list[MethodState] | None = None,
    replay_rows: int = 64,
) -> StageStart:
    """Create the start of a stage."""
    selected: list[MethodState] = [{} for _ in memories] if states is None else states
    return StageStart(head, teacher, memories, selected, replay_rows)


def flat(head: Head) -> Tensor:
    """Copy all weights, (p,)."""
    return torch.cat([value.detach().flatten() for value in head.parameters()]).clone()


def flat_of(head: Head, named: dict[str, Tensor]) -> Tensor:
    """Concatenate tensors by parameter name, in the order of `flat`."""
    return torch.cat(
        [named[name].flatten() for name, _ in head.named_parameters()]
    ).clone()
