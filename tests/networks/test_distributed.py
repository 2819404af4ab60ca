"""Two processes with half a batch each leave the gradients that one has with the whole batch."""

import os
from pathlib import Path

import pytest
import torch
from torch import Tensor, distributed
from torch.multiprocessing import spawn  # pyright: ignore[reportPrivateImportUsage]

from evercal.geometry import SE3
from evercal.networks.buffer import FeatureBuffer, Rows
from evercal.networks.distributed import own_share, processes, rank
from evercal.networks.head import Head, HeadOptions, HeadOutput
from evercal.networks.hooks import ProposedStep, TrainingHooks
from evercal.networks.loss import Target
from evercal.networks.trainer import FitOptions, HeadTrainer

OPTIONS = FitOptions(iterations=4, batch=64)
RULES = ("cost", "constraints")


def buffer_of(scene: int) -> FeatureBuffer:
    """Rows of points in front of two cameras; features are the points themselves."""
    generator = torch.Generator().manual_seed(scene)
    buffer = FeatureBuffer(scene, SE3.identity(), correctable=True)
    points = torch.randn(200, 3, generator=generator) + torch.tensor([0.0, 0, 4])
    features = torch.cat([points.sin(), points.cos(), points], 1)
    buffer.restore(
        {
            "features": features.half(),
            "pixels": 100 * points[:, :2] / points[:, 2:] + 50,
            "view": torch.arange(2, dtype=torch.int32).repeat_interleave(100),
            "intrinsics": torch.tensor([[100.0, 100, 50, 50]] * 2),
            "camera_from_atlas": torch.eye(4)[None, :3].repeat(2, 1, 1),
            "descriptors": torch.nn.functional.normalize(torch.ones(2, 4), dim=-1),
        }
    )
    return buffer


class Both(TrainingHooks):
    """Remembered scenes cost something, or constrain the step; keeps what it was shown."""

    def __init__(self, rule: str, memories: list[FeatureBuffer]):
        self.rule, self.memories, self.seen = rule, memories, dict[str, Tensor]()
        self.edits_steps = rule == "constraints"

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: torch.Generator
    ) -> list[Rows]:
        return [memory.draw(16, generator) for memory in self.memories]

    def cost(self, output: HeadOutput, rows: Rows, progress: float) -> Tensor | None:
        if self.rule == "constraints":
            return None
        return (output.points - rows.features[:, 6:].float()).abs().mean()

    def constraints(self, output: HeadOutput, rows: Rows, progress: float) -> list[Tensor]:
        if self.rule == "cost":
            return []
        each = len(rows.scene) // 2
        off = (output.points - rows.features[:, 6:].float()).abs().mean(1)
        return [off[:each].mean(), off[each:].mean()]

    def edit_step(self, proposed: ProposedStep) -> None:
        self.seen = {"losses": proposed.losses}
        for i, constraint in enumerate(proposed.constraints):
            self.seen |= {f"{i}.{name}": value.clone() for name, value in constraint.items()}


def gradients(rule: str, steps: int = 1) -> dict[str, Tensor]:
    """What is in `.grad` after some steps of training, and what the hooks were shown."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    buffers = [buffer_of(scene) for scene in range(3)]
    head = Head(9, 4, HeadOptions(width=16, blocks=1, whiten=False))
    for scene in range(3):
        head.grow(torch.randn(2, 3), seed=scene)
    hooks = Both(rule, buffers[:2])
    trainer = HeadTrainer(head, buffers[2:], OPTIONS, 1, hooks)
    run = trainer.run()
    for _ in range(steps):
        next(run)
    found = {name: value.grad for name, value in head.named_parameters()}
    return {name: value for name, value in found.items() if value is not None} | hooks.seen


def _worker(number: int, rule: str, folder: str) -> None:
    rendezvous = f"file://{folder}/rendezvous"
    distributed.init_process_group("gloo", init_method=rendezvous, rank=number, world_size=2)
    assert (processes(), rank()) == (2, number)
    torch.save(gradients(rule), f"{folder}/{number}.pt")
    distributed.destroy_process_group()


@pytest.mark.parametrize("rule", RULES)
def test_two_processes_leave_the_gradients_of_one(rule: str, tmp_path: Path) -> None:
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    spawn(_worker, (rule, str(tmp_path)), nprocs=2)
    alone = gradients(rule)
    found = [torch.load(tmp_path / f"{number}.pt", weights_only=True) for number in range(2)]
    assert found[0].keys() == found[1].keys() == alone.keys()
    assert ("losses" in alone) == (rule == "constraints")
    for name, value in alone.items():
        assert torch.equal(found[0][name], found[1][name]), name
        # Products in half precision differ with the shape of the batch.
        size = float(value.abs().max()) + 1e-6
        torch.testing.assert_close(found[0][name], value, atol=0.02 * size, rtol=0.02)


def test_alone_a_process_keeps_every_row() -> None:
    zero = torch.zeros(5, dtype=torch.long)
    target = Target(torch.zeros(5, 2), torch.zeros(5, 4), torch.zeros(5, 3, 4))
    rows = Rows(torch.zeros(5, 1), zero, torch.zeros(5, 1), target, zero)
    assert own_share(rows) is rows
    assert (processes(), rank()) == (1, 0)
