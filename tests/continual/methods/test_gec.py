"""Gradient constraints hold for the applied step of the optimisers."""

import copy
import itertools

import numpy as np
import pytest
import torch

from evercal.continual.methods.gec import EpisodicConstraint, nearest_change
from evercal.continual.methods.method import FinishedScene, MethodState
from evercal.continual.networks.buffer import diffused
from evercal.continual.networks.head import HeadOptions
from evercal.continual.networks.hooks import ProposedStep
from evercal.continual.networks.loss import (
    LossOptions,
    reprojection_loss,
)
from evercal.continual.networks.trainer import FitOptions, HeadTrainer, one_cycle

from ..draws import seeded
from .by_hand import (
    flat,
    flat_of,
    head_output,
    off_by,
    rows,
    stage_start,
    wave_buffer,
    wave_head,
)

# Shampoo trains the square matrices, AdamW with decay the rest, both with momentum.
OPTIONS = FitOptions(iterations=14, batch=64, replay_batch=64, peak_rate=1e-2)


def slow_nearest(changes: np.ndarray, g: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Search all sets of active constraints for the nearest allowed change."""
    best = np.inf
    actual = None
    for count in range(min(len(g), len(changes)) + 1):
        for active in itertools.combinations(range(len(g)), count):
            a = g[list(active)]
            if count and np.linalg.matrix_rank(a) < count:
                continue
            u = changes.copy()
            if count:
                u -= a.T @ np.linalg.solve(a @ a.T, a @ changes - most[list(active)])
            if (g @ u <= most + 1e-9).all() and np.linalg.norm(u - changes) < best:
                best = float(np.linalg.norm(u - changes))
                actual = u
    assert actual is not None
    return actual


def nearest(changes: np.ndarray, g: np.ndarray, most: np.ndarray) -> np.ndarray:
    context = nearest_change(*(torch.from_numpy(part) for part in (changes, g, most)))
    return context.double().numpy()


@pytest.mark.parametrize("seed", range(15))
def test_nearest_change_equals_search_over_active_sets(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 1 + seed % 5
    size = 7
    changes = rng.normal(size=size)
    g = rng.normal(size=(count, size))
    # Gradient lengths differ by orders of magnitude.
    g *= 10.0 ** rng.uniform(-4, 4, (count, 1))
    most = rng.uniform(-1, 1, count) * np.linalg.norm(g, axis=1) * (seed % 3 > 0)
    actual = nearest(changes, g, most)
    np.testing.assert_allclose(actual, slow_nearest(changes, g, most), atol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_parallel_constraints_have_a_solution(seed: int) -> None:
    # Along one direction the tightest constraint is active.
    rng = np.random.default_rng(seed)
    along = rng.normal(size=5)
    g = along * np.array([[1.0], [1.0], [2.0], [30.0]])
    most = np.array([-0.1, 0.2, 0.5, 3.0]) * (along @ along)
    changes = 3 * along + rng.normal(size=5)
    tightest = min(-0.1, 0.2, 0.25, 0.1)
    excess = changes @ along / (along @ along) - tightest
    np.testing.assert_allclose(
        nearest(changes, g, most), changes - excess * along, atol=1e-6
    )


def test_constraint_without_a_gradient_is_ignored() -> None:
    changes = np.array([1.0, 2.0])
    g = np.array([[0.0, 0.0], [0.0, 1.0]])
    np.testing.assert_allclose(
        nearest(changes, g, np.array([-1.0, 0.0])), [1.0, 0.0], atol=1e-8
    )
    np.testing.assert_allclose(nearest(changes, g[:1], np.array([-1.0])), changes)


def test_applied_step_satisfies_every_constraint() -> None:
    """A new scene contradicts two remembered ones."""
    method = EpisodicConstraint(alpha=0.5, warm_steps=0)
    head = wave_head(3)
    proposals = []
    memories = [wave_buffer(i, shift_px=3.0 * i) for i in range(2)]
    states: list[MethodState] = [
        {"reference": torch.tensor(20.0 - 9 * i)} for i in range(2)
    ]
    hooks = method.begin(stage_start(head, memories, states=states))
    edit = hooks.edit_step

    def recorded(proposed: ProposedStep) -> None:
        proposals.append(copy.deepcopy(proposed))
        edit(proposed)

    hooks.edit_step = recorded  # type: ignore[method-assign]
    new = wave_buffer(2, shift_px=-12.0)
    before = flat(head)
    active = 0
    for _ in HeadTrainer(head, [new], OPTIONS, 0, hooks).run():
        proposed = proposals[-1]
        after = flat(head)
        wanted = flat_of(head, proposed.changes)
        taken = after - before
        g = torch.stack([flat_of(head, dict(one)) for one in proposed.constraints])
        h = proposed.losses - 1.05 * torch.tensor([20.0, 11.0])
        most = -0.5 * 0.03 * one_cycle(OPTIONS, proposed.step) / OPTIONS.peak_rate * h
        allowed = slow_nearest(*(v.double().numpy() for v in (wanted, g, most)))
        np.testing.assert_allclose(
            taken.numpy(), allowed, atol=1e-4 * float(wanted.norm())
        )
        active += bool((g @ wanted > most).any())
        before = after
    assert 3 < active <= len(proposals) == OPTIONS.iterations


def test_constraint_gradients_are_of_the_remembered_losses() -> None:
    """Constraint gradients equal the gradients of the loss on the replayed rows."""
    head = wave_head(3)
    method = EpisodicConstraint()
    memories = [wave_buffer(i, shift_px=3.0 * i) for i in range(2)]
    states: list[MethodState] = [{"reference": torch.tensor(1.0)}] * 2
    hooks = method.begin(stage_start(head, memories, states=states))
    before = copy.deepcopy(head)
    records = []
    parts = []
    replayed = hooks.replayed
    hooks.replayed = lambda *words: parts.append(replayed(*words)) or parts[-1]  # type: ignore
    hooks.edit_step = lambda proposed: records.append(copy.deepcopy(proposed))  # type: ignore
    next(HeadTrainer(head, [wave_buffer(2)], OPTIONS, 0, hooks).run())
    for part, loss, g in zip(
        parts[0], records[0].losses, records[0].constraints, strict=True
    ):
        points = before(part.features.float(), part.scene, part.descriptor).points
        cost, _ = reprojection_loss(points, part.target, 50.0, LossOptions())
        exact = torch.autograd.grad(
            cost.mean(), list(before.parameters()), materialize_grads=True
        )
        slope = torch.cat([one.flatten() for one in exact])
        assert float(loss) == pytest.approx(float(cost.detach().mean()), rel=0.02)
        actual = flat_of(head, g)
        assert float(actual @ slope / actual.norm() / slope.norm()) > 0.99
        assert float(actual.norm()) == pytest.approx(float(slope.norm()), rel=0.05)


def proposed_of(
    losses: list[float], change: list[float], step: int = 100, schedule: float = 1.0
) -> ProposedStep:
    """Create a step with one weight per scene, with gradient 1."""
    constraints = [{"w": row} for row in torch.eye(len(losses))]
    changes = {"w": torch.tensor(change)}
    return ProposedStep(changes, torch.tensor(losses), constraints, step, schedule)


def edited(
    method: EpisodicConstraint, proposed: ProposedStep, references: list[float]
) -> list[float]:
    g = torch.stack([one["w"] for one in proposed.constraints])
    change = proposed.changes["w"]
    actual = method.edit_step(change, g, proposed, torch.tensor(references))
    return [round(float(value), 6) for value in actual]


def test_episodic_constraint_by_hand() -> None:
    gec = EpisodicConstraint(alpha=0.5, eta=0.1, longest=9.0)
    # h = 5 - 1.05 x 2 = 2.9: the loss must fall by 0.5 x 0.1 x 2.9; below the reference, with
    # h = 1 - 2.1 = -1.1, it may rise by 0.055.
    proposed = proposed_of([5.0, 1.0], [0.3, 0.3])
    assert edited(gec, proposed, [2.0, 2.0]) == [-0.145, 0.055]
    # A sufficient fall, and an allowed rise, are not edited.
    assert edited(gec, proposed_of([5.0, 1.0], [-0.2, 0.05]), [2.0, 2.0]) == [
        -0.2,
        0.05,
    ]
    # Half the learning rate halves the bound; the slack is relative to the reference.
    assert edited(gec, proposed_of([5.0], [0.3], schedule=0.5), [2.0]) == [-0.0725]
    slack = EpisodicConstraint(alpha=1.0, eta=0.1, slack=0.5, longest=9.0)
    assert edited(slack, proposed_of([3.0], [0.3]), [2.0]) == [0.0]
    # Warm-up steps are not edited.
    assert edited(gec, proposed_of([5.0], [0.3], step=4), [2.0]) == [pytest.approx(0.3)]
    assert edited(gec, proposed_of([5.0], [0.3], step=5), [2.0]) == [-0.145]
    # The added length is at most the length of the step.
    assert edited(EpisodicConstraint(), proposed_of([900.0], [0.3]), [2.0]) == [0.0]


def test_first_steps_are_plain_replay() -> None:
    head = wave_head(3)
    memories = [wave_buffer(i) for i in range(2)]
    reference: list[MethodState] = [{"reference": torch.tensor(1.0)}] * 2
    hooks = EpisodicConstraint().begin(stage_start(head, memories, states=reference))
    output = head_output([off_by(3.0), off_by(1.0)])
    some = rows(2)
    costs = []
    for step in range(7):
        cost = hooks.cost(output, some, 1.0)
        costs.append(None if cost is None else float(cost.detach()))
        proposed = proposed_of([9.0, 9.0], [0.5, 0.5], step=step)
        hooks.edit_step(proposed)
        moved = (proposed.changes["w"] - 0.5).abs().max() > 0
        assert bool(moved) == (step >= 5)
    # With a clamp of 1 px: the mean of tanh 3 and tanh 1.
    assert costs[:5] == pytest.approx([(np.tanh(3.0) + np.tanh(1.0)) / 2] * 5, rel=1e-5)
    assert costs[5:] == [None, None]


@pytest.mark.parametrize("diffusion", [0.0, 5.0])
def test_reference_is_the_loss_of_rows_as_they_are_replayed(diffusion: float) -> None:
    """Of the keyframes, not of the training frames, with the noise of their descriptors."""
    options = HeadOptions(16, 1, "descriptor", centres="fixed", whiten=False)
    head = wave_head(2, options)
    replayed = wave_buffer(1, shift_px=20.0)
    scene = FinishedScene(head, 1, lambda: wave_buffer(1), lambda: replayed, diffusion)
    actual = EpisodicConstraint().after_scene(scene)["reference"]
    some = diffused(replayed.draw(8192, seeded(1)), diffusion, seeded(1))
    with torch.no_grad():
        points = head(some.features.float(), 1, some.descriptor).points
    loss, _ = reprojection_loss(points, some.target, 50.0, LossOptions())
    assert float(actual) == pytest.approx(float(loss.mean()), rel=1e-5)
