"""The training loop: its schedule, its seeds, stopping and going on, and that it learns."""

import copy
from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import pytest
import torch
from torch import Tensor

from evercal.features.views import cell_centres
from evercal.geometry import SE3, Camera
from evercal.networks.buffer import FeatureBuffer, Rows
from evercal.networks.head import Head, HeadOptions, HeadOutput
from evercal.networks.loss import LossOptions, reprojection_error
from evercal.networks.trainer import (
    FitOptions,
    HeadTrainer,
    Progress,
    Replay,
    one_cycle,
    replayed_rows,
)

CAMERA = Camera(160, 120, 131.0, 128.0, 79.5, 59.5)
CHANNELS, DESCRIPTOR = 48, 6
ATLAS_FROM_BASE = SE3.exp([5.0, -5.0, 0.0, 0.0, 0.0, 0.7])
OPTIONS = FitOptions(
    iterations=20,
    batch=96,
    replay_batch=60,
    peak_rate=3e-3,
    loss=LossOptions(schedule="circle", clamp_start_px=25.0, clamp_end_px=1.0),
)

Learnable = Callable[..., tuple[FeatureBuffer, Tensor]]


def head_for(buffers: list[FeatureBuffer], options: HeadOptions | None = None) -> Head:
    torch.manual_seed(0)
    head = Head(CHANNELS, DESCRIPTOR, options or HeadOptions(width=32))
    for buffer in buffers:
        matrix = buffer.tensors["camera_from_atlas"].double().numpy()
        atlas_from_camera = SE3.from_matrix(matrix).inverse()
        head.grow(torch.from_numpy(atlas_from_camera.translation_m[:3]).float(), seed=buffer.scene)
    return head


def snapshot(trainer: HeadTrainer) -> dict[str, Tensor]:
    return {key: value.clone() for key, value in trainer.state().items()}


@pytest.mark.parametrize(("iterations", "warm"), [(100, 0.05), (1000, 0.3), (40, 0.5)])
def test_the_rate_follows_torchs_one_cycle(iterations: int, warm: float) -> None:
    """Up over warm * iterations steps and down to zero at the step that would come next."""
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


@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_the_shortest_schedules_have_a_rate(iterations: int) -> None:
    options = FitOptions(iterations=iterations)
    rates = [one_cycle(options, step) for step in range(iterations)]
    assert all(0 < rate <= options.peak_rate for rate in rates)


@pytest.mark.parametrize("stop", [3, 10, 17])
@pytest.mark.parametrize("condition", ["code", "descriptor"])
def test_stopping_and_going_on_changes_nothing(
    learnable: Learnable, stop: int, condition: str
) -> None:
    """Twenty steps in one go, and in two goes by two fitters that share only the saved state."""
    fresh, _ = learnable(1, correctable=True)
    past, _ = learnable(0)
    shape = HeadOptions(width=32, condition=condition)  # pyright: ignore[reportArgumentType]
    head = head_for([past, fresh], shape)
    twin, third = copy.deepcopy(head), copy.deepcopy(head)
    replay = Replay([past], lambda output, rows, progress: output.points.abs().mean())

    whole = HeadTrainer(head, [fresh], replay, OPTIONS, seed=3)
    expected = list(whole.run())
    first = HeadTrainer(twin, [fresh], replay, OPTIONS, seed=3)
    found = list(islice(first.run(), stop))
    saved = snapshot(first)
    second = HeadTrainer(third, [fresh], replay, OPTIONS, seed=3)
    second.load(saved)
    found += list(second.run())

    assert [p.step for p in found] == list(range(1, 21))
    assert found == expected
    for (name, value), other in zip(
        head.state_dict().items(), third.state_dict().values(), strict=True
    ):
        assert torch.equal(value, other), name
    assert torch.equal(whole.correction, second.correction)
    assert (whole.correction != 0).any()
    assert not third.training


def test_loading_does_not_tie_two_fitters_together(learnable: Learnable) -> None:
    buffer, _ = learnable()
    first = HeadTrainer(head_for([buffer]), [buffer], None, OPTIONS, seed=0)
    list(islice(first.run(), 4))
    saved = snapshot(first)
    second = HeadTrainer(head_for([buffer]), [buffer], None, OPTIONS, seed=0)
    second.load({key: value.clone() for key, value in saved.items()})
    list(islice(second.run(), 4))
    for key, value in first.state().items():
        assert torch.equal(value, saved[key]), key


def test_a_state_stays_what_it_was_when_training_goes_on(learnable: Learnable) -> None:
    buffer, _ = learnable()
    trainer = HeadTrainer(head_for([buffer]), [buffer], None, OPTIONS, seed=0)
    list(islice(trainer.run(), 4))
    state = trainer.state()
    before = {key: value.clone() for key, value in state.items()}
    list(islice(trainer.run(), 4))
    assert all(torch.equal(state[key], value) for key, value in before.items())


class Spied(FeatureBuffer):
    """Writes down which rows were drawn."""

    drawn: list[Tensor]

    def draw(self, count: int, generator: torch.Generator) -> Rows:
        rows = super().draw(count, generator)
        self.drawn.append(rows.index)
        return rows


def test_rows_depend_on_seed_and_step_alone(learnable: Learnable) -> None:
    plain, _ = learnable()

    def drawn(seed: int, start: int, options: FitOptions = OPTIONS) -> list[Tensor]:
        buffer = Spied(0, ATLAS_FROM_BASE)
        buffer.restore(plain.tensors)
        buffer.drawn = []
        trainer = HeadTrainer(head_for([plain]), [buffer], None, options, seed)
        trainer.step = start
        list(trainer.run())
        return buffer.drawn

    whole = drawn(2, 0)
    assert len(whole) == 20
    assert len({tuple(index.tolist()) for index in whole}) == 20
    late = drawn(2, 13, replace(OPTIONS, peak_rate=1e-4))
    assert all(torch.equal(a, b) for a, b in zip(late, whole[13:], strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(whole, drawn(3, 0), strict=True))


def test_replay_gets_remembered_rows_evenly_and_its_cost_is_trained(learnable: Learnable) -> None:
    buffers = [learnable(scene)[0] for scene in range(3)]
    seen: list[tuple[Tensor, float]] = []
    # A cost that fresh rows alone would never pay: all logits' biases of scene 0 to -3.
    head = head_for(buffers)

    def penalty(output: HeadOutput, rows: Rows, progress: float) -> Tensor:
        assert len(output.points) == len(rows.scene) == len(rows.features)
        seen.append((rows.scene, progress))
        own = output.logits[rows.scene == 0][:, head.centre_scene == 0]
        return 100 * (own + 3).square().mean()

    def mean_logit() -> float:
        rows = buffers[0].draw(200, torch.Generator().manual_seed(0))
        with torch.no_grad():
            return float(head(rows.features.float(), 0, None).logits.mean())

    before = mean_logit()
    options = replace(OPTIONS, iterations=60, peak_rate=1e-2)
    list(HeadTrainer(head, buffers[2:], Replay(buffers[:2], penalty), options, 0).run())
    assert abs(mean_logit() + 3) < 0.3 < abs(before + 3)
    for scene, _ in seen:
        assert torch.bincount(scene, minlength=3).tolist() == [30, 30, 0]
    assert [progress for _, progress in seen] == pytest.approx([i / 60 for i in range(60)])


@pytest.mark.parametrize(
    ("scenes", "rows"), [(1, 60), (2, 60), (3, 90), (7, 210), (8, 240), (12, 240), (500, 500)]
)
def test_replayed_rows_grow_with_the_scenes(scenes: int, rows: int) -> None:
    assert replayed_rows(OPTIONS, scenes) == rows


@pytest.mark.parametrize(
    ("remembered", "per_scene", "expected"),
    [(1, False, 1), (2, False, 1), (1, True, 1), (2, True, 2), (3, True, 3)],
)
def test_remembered_scenes_cost_each_or_together(
    remembered: int, per_scene: bool, expected: float, learnable: Learnable
) -> None:
    """The penalty alone moves the head here; plain gradient steps show how much it counts."""
    buffers = [learnable(scene)[0] for scene in range(remembered + 1)]
    moved = []
    for scale in (1.0, 2.0):
        head = head_for(buffers)

        def penalty(
            output: HeadOutput, rows: Rows, progress: float, scale=scale, bias=head.logit_bias
        ) -> Tensor:
            return scale * bias.sum() + 0 * output.points.sum()

        replay = Replay(buffers[:-1], penalty, per_scene)
        trainer = HeadTrainer(head, buffers[-1:], replay, replace(OPTIONS, iterations=1), 0)
        next(trainer.run())
        gradient = head.logit_bias.grad
        assert gradient is not None
        moved.append(float(gradient[head.centre_scene == 0].mean()))
    assert moved == pytest.approx([expected, 2 * expected])


def test_several_scenes_share_a_batch_evenly(learnable: Learnable) -> None:
    buffers = [learnable(scene)[0] for scene in range(3)]
    head, seen = head_for(buffers), []
    head.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[1]))
    list(HeadTrainer(head, buffers, None, replace(OPTIONS, iterations=2), 0).run())
    for scene in seen:
        assert torch.bincount(scene).tolist() == [32, 32, 32]


def test_descriptors_are_shaken_and_stay_unit_vectors(learnable: Learnable) -> None:
    buffer, _ = learnable()
    kept = buffer.tensors["descriptors"].clone()
    head, seen = head_for([buffer], HeadOptions(width=16, condition="descriptor")), []
    head.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[2]))
    options = replace(OPTIONS, iterations=1, batch=4000, diffusion=0.5)
    list(HeadTrainer(head, [buffer], None, options, 0).run())
    (shaken,) = seen
    assert torch.equal(buffer.tensors["descriptors"], kept)
    torch.testing.assert_close(shaken.norm(dim=-1), torch.ones(4000))
    rows = buffer.draw(4000, torch.Generator().manual_seed(0))
    cosine = (shaken * rows.descriptor.float()).sum(-1)
    noise = torch.randn(200_000, DESCRIPTOR) * 0.5
    noise[:, 0] += 1  # any direction will do
    expected = float((noise[:, 0] / noise.norm(dim=-1)).mean())
    assert float(cosine.mean()) == pytest.approx(expected, abs=0.02)


def test_a_small_head_learns_where_things_are(learnable: Learnable) -> None:
    """From reprojection alone it must find the depth that several views agree on."""
    buffer, points = learnable(views=20)
    head = head_for([buffer], HeadOptions(width=64))
    every = buffer.rows(torch.arange(len(buffer)))

    def judge() -> tuple[float, float]:
        with torch.no_grad():
            found = head(every.features.float(), 0, None).points
            pixels = reprojection_error(found, every.target)[0].norm(dim=-1)
        return float(pixels.median()), float((found - points).norm(dim=-1).median())

    pixels_before, metres_before = judge()
    options = FitOptions(iterations=200, batch=512, peak_rate=5e-3, loss=OPTIONS.loss)
    progress = list(HeadTrainer(head, [buffer], None, options, 0).run())
    pixels, metres = judge()
    assert pixels < 3.0 < 30.0 < pixels_before
    assert metres < 0.15 < 1.5 < metres_before
    assert progress[-1].loss < 0.15 * progress[0].loss
    assert progress[-1].inlier_share > 0.8
    assert progress[0].inlier_share < 0.1


def test_a_wrong_lens_is_corrected_where_it_may_be(learnable: Learnable) -> None:
    """Images through a lens 4 % longer than stated, and with some barrel."""
    true = replace(CAMERA, fx=CAMERA.fx * 1.04, fy=CAMERA.fy * 1.04, distortion=(-0.1, 0, 0, 0))
    options = FitOptions(iterations=400, batch=512, peak_rate=5e-3, intrinsics_rate=1.0)
    options = replace(options, loss=OPTIONS.loss)
    rays = torch.from_numpy(true.unproject(cell_centres(120, 160, 8))).float()
    for correctable, steps in ((True, 400), (False, 30)):
        buffer, _ = learnable(views=20, lens=true, correctable=correctable)
        head = head_for([buffer], HeadOptions(width=64))
        trainer = HeadTrainer(head, [buffer], None, replace(options, iterations=steps), 0)
        list(trainer.run())
        # How far off the lens is on its own, with the pose out of the question.
        where = buffer.rows(torch.arange(300)).target
        where.camera_from_atlas = torch.eye(3, 4).expand(300, 3, 4)
        off, _ = reprojection_error(rays, where, trainer.correction[0].expand(300, 5))
        stated, _ = reprojection_error(rays, where)
        if correctable:
            assert off.norm(dim=-1).mean() < 0.5 * stated.norm(dim=-1).mean()
            assert trainer.correction[0, 0] > 0.015
        else:
            assert (trainer.correction == 0).all()


def test_progress_says_what_the_last_step_saw(learnable: Learnable) -> None:
    buffer, _ = learnable()
    trainer = HeadTrainer(head_for([buffer]), [buffer], None, replace(OPTIONS, iterations=2), 0)
    first, second = trainer.run()
    assert (first.step, second.step, first.total) == (1, 2, 2)
    assert isinstance(first, Progress)
    rows = buffer.draw(96, torch.Generator().manual_seed(0))
    with torch.no_grad(), torch.autocast("cpu", enabled=False):
        points = head_for([buffer])(rows.features.float(), rows.scene, None).points
        residual, camera = reprojection_error(points, rows.target)
    clear = (camera[:, 2] > 0.1) & (residual.abs().sum(-1) < 1000)
    inside = clear & (residual.norm(dim=-1) < 5)
    assert first.inlier_share == pytest.approx(float(inside.float().mean()), abs=0.05)


def test_a_rule_that_adds_gradients_up_is_plain_replay(learnable: Learnable) -> None:
    buffers = [learnable(scene)[0] for scene in range(3)]
    heads = []

    def penalty(output: HeadOutput, rows: Rows, progress: float) -> Tensor:
        return output.points.abs().mean()

    for combine in (None, lambda g: g.new + g.memory.mean(0)):
        head = head_for(buffers)
        replay = Replay(buffers[:2], penalty, combine=combine)
        # Plain descent, which tells sums of gradients apart where Adam and Muon would not.
        trainer = HeadTrainer(head, buffers[2:], replay, OPTIONS, 0)
        next(trainer.run())
        heads.append({name: value.grad for name, value in head.named_parameters()})
    for name, gradient in heads[0].items():
        assert gradient is not None
        torch.testing.assert_close(heads[1][name], gradient, atol=2e-3, rtol=2e-2)


def test_a_restraint_pulls_the_weights(learnable: Learnable) -> None:
    buffer, _ = learnable()
    norms = []
    for strength in (0.0, 1e3):
        head = head_for([buffer])
        anchor = head.logit.detach().clone()

        def regularizer(head: Head = head, anchor: Tensor = anchor, s: float = strength) -> Tensor:
            return s * (head.logit - anchor).square().sum()

        list(HeadTrainer(head, [buffer], None, OPTIONS, 0, regularizer).run())
        norms.append(float((head.logit.detach() - anchor).norm()))
    assert norms[1] < 0.3 * norms[0]
