"""The training loop: schedule, seeds, hooks, and learning."""

import copy
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from evercal.continual.networks.buffer import FeatureBuffer, Rows
from evercal.continual.networks.head import HeadOptions, HeadOutput
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks
from evercal.continual.networks.loss import LossOptions, clamp_px
from evercal.continual.networks.trainer import FitOptions, HeadTrainer, one_cycle

from ..box_features import Learnable, head_at_cameras
from ..draws import seeded
from ..stages import weights

OPTIONS = FitOptions(
    iterations=20,
    batch=96,
    replay_batch=60,
    peak_rate=3e-3,
    loss=LossOptions(schedule="circle", clamp_start_px=25.0, clamp_end_px=1.0),
)

Cost = Callable[[HeadOutput, Rows, float], Tensor]


class Replayed(TrainingHooks):
    """Replays thirty rows of each buffer with a given loss."""

    def __init__(self, memories: list[FeatureBuffer], penalty: Cost):
        self.memories = memories
        self.penalty = penalty

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: torch.Generator
    ) -> list[Rows]:
        return [memory.draw(30, generator) for memory in self.memories]

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        return self.penalty(output, rows, tau_px)


@pytest.mark.parametrize(("iterations", "warm"), [(100, 0.05), (1000, 0.3), (40, 0.5)])
def test_rate_follows_one_cycle_of_torch(iterations: int, warm: float) -> None:
    """Up for warm * iterations steps, then down to zero after the last step."""
    options = FitOptions(iterations=iterations, warm_share=warm, peak_rate=2e-3)
    rise = round(warm * iterations)
    optimiser = torch.optim.SGD([torch.zeros(1, requires_grad=True)])
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser,
        2e-3,
        total_steps=iterations + 1,
        pct_start=(rise + 1) / (iterations + 1),
        final_div_factor=1e9,
        cycle_momentum=False,
    )
    for step in range(iterations):
        expected = schedule.get_last_lr()[0]
        assert one_cycle(options, step) == pytest.approx(expected, abs=1e-9)
        optimiser.step()
        schedule.step()
    assert one_cycle(options, 0) == pytest.approx(2e-3 / 25)
    assert one_cycle(options, rise) == pytest.approx(2e-3)
    assert one_cycle(options, iterations) == pytest.approx(0.0, abs=1e-12)


def test_replay_cost_is_minimised_on_even_shares(learnable: Learnable) -> None:
    buffers = [learnable(scene)[0] for scene in range(3)]
    captured: list[tuple[Tensor, float]] = []
    # This loss, which new rows do not have, moves the logits of scene 0 to -3.
    head = head_at_cameras(buffers)

    def penalty(output: HeadOutput, rows: Rows, tau_px: float) -> Tensor:
        assert len(output.points) == len(rows.scene) == len(rows.features)
        captured.append((rows.scene, tau_px))
        own = output.logits[rows.scene == 0][:, head.centre_scene == 0]
        return 100 * (own + 3).square().mean()

    def mean_logit() -> float:
        rows = buffers[0].draw(200, seeded(0))
        with torch.no_grad():
            return float(head(rows.features.float(), 0, None).logits.mean())

    before = mean_logit()
    options = replace(OPTIONS, iterations=60, peak_rate=1e-2)
    list(
        HeadTrainer(head, buffers[2:], options, 0, Replayed(buffers[:2], penalty)).run()
    )
    assert abs(mean_logit() + 3) < 0.3 < abs(before + 3)
    for scene, _ in captured:
        assert torch.bincount(scene, minlength=3).tolist() == [30, 30, 0]
    # Clamps of the new rows.
    clamps = [clamp_px(options.loss, i / 60) for i in range(60)]
    assert [tau_px for _, tau_px in captured] == pytest.approx(clamps)


def test_descriptor_noise_has_the_stated_size(learnable: Learnable) -> None:
    buffer, _ = learnable()
    selected = buffer.tensors["descriptors"].clone()
    head = head_at_cameras([buffer], HeadOptions(width=16, condition="descriptor"))
    captured = []
    head.register_forward_pre_hook(lambda _, inputs: captured.append(inputs[2]))
    options = replace(OPTIONS, iterations=1, batch=4000, diffusion=0.5)
    list(HeadTrainer(head, [buffer], options, 0).run())
    (shaken,) = captured
    assert torch.equal(buffer.tensors["descriptors"], selected)
    torch.testing.assert_close(shaken.norm(dim=-1), torch.ones(4000))
    rows = buffer.draw(4000, seeded(0))
    cosine = (shaken * rows.descriptor.float()).sum(-1)
    noise = torch.randn(200_000, 6) * 0.5
    noise[:, 0] += 1  # an arbitrary direction
    expected = float((noise[:, 0] / noise.norm(dim=-1)).mean())
    assert float(cosine.mean()) == pytest.approx(expected, abs=0.02)


class StepRecorder(Replayed):
    """Sums the proposed changes and records the last step."""

    edits_steps = True

    def __init__(self, memories: list[FeatureBuffer], penalty: Cost):
        super().__init__(memories, penalty)
        self.distance: dict[str, Tensor] = {}
        self.last: ProposedStep | None = None
        self.schedules: list[float] = []

    def constraints(self, output: HeadOutput, rows: Rows) -> list[Tensor]:
        return [output.points[:30].square().mean(), output.points[30:].square().mean()]

    def edit_step(self, proposed: ProposedStep) -> None:
        for name, change in proposed.changes.items():
            self.distance[name] = self.distance.get(name, 0) + change.double()
        self.schedules.append(proposed.schedule)
        self.last = copy.deepcopy(proposed)


def test_proposed_changes_sum_to_the_change_of_the_weights(
    learnable: Learnable,
) -> None:
    """Holds for AdamW with decay and Shampoo with momentum."""
    buffers = [learnable(scene)[0] for scene in range(3)]
    head = head_at_cameras(buffers)
    first = weights(head)
    hooks = StepRecorder(
        buffers[:2], lambda output, rows, tau_px: output.points.abs().mean()
    )
    list(HeadTrainer(head, buffers[2:], OPTIONS, 0, hooks).run())
    for name, value in head.named_parameters():
        moved = value.detach().double() - first[name].double()
        torch.testing.assert_close(hooks.distance[name], moved, rtol=0, atol=2e-6)
    assert any(
        float(distance.abs().max()) > 1e-3 for distance in hooks.distance.values()
    )
    shares = [one_cycle(OPTIONS, step) / OPTIONS.peak_rate for step in range(20)]
    assert hooks.schedules == pytest.approx(shares)


def test_constraints_are_not_minimised(learnable: Learnable) -> None:
    """Constraints do not change the step, and each gradient belongs to one scene's rows."""
    buffers = [learnable(scene)[0] for scene in range(3)]

    def nothing(output: HeadOutput, rows: Rows, tau_px: float) -> Tensor:
        return 0 * output.points.sum()

    watched = head_at_cameras(buffers)
    plain = head_at_cameras(buffers)
    hooks = StepRecorder(buffers[:2], nothing)
    next(HeadTrainer(watched, buffers[2:], OPTIONS, 0, hooks).run())
    next(
        HeadTrainer(
            plain, buffers[2:], OPTIONS, 0, Replayed(buffers[:2], nothing)
        ).run()
    )
    for name, value in watched.named_parameters():
        torch.testing.assert_close(value, plain.get_parameter(name), rtol=0, atol=1e-6)
    assert hooks.last is not None
    assert len(hooks.last.constraints) == len(hooks.last.losses) == 2
    for scene, gradient in enumerate(hooks.last.constraints):
        used = gradient["code"].abs().sum((1, 2)) > 0
        assert used.tolist() == [number == scene for number in range(3)]
        assert float(gradient["first.1.weight"].abs().max()) > 0
