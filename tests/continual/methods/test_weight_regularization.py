"""EWC, SI and MAS: cost and importances against closed forms."""

import copy
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from evercal.continual.methods.method import FinishedScene, MethodState
from evercal.continual.methods.weight_regularization import (
    ElasticWeightConsolidation,
    MemoryAwareSynapses,
    SynapticIntelligence,
    WeightRegularization,
    mean_over_images,
)
from evercal.continual.networks.head import Head
from evercal.continual.networks.hooks import ProposedStep
from evercal.continual.networks.loss import LossOptions, reprojection_loss
from evercal.continual.networks.trainer import FitOptions, HeadTrainer

from .by_hand import flat, stage_start, wave_buffer, wave_head

OPTIONS = FitOptions(iterations=8, batch=64, peak_rate=1e-2)


def tied(head: Head, importance: float, shift: float = 0.0) -> dict[str, Tensor]:
    """Create a state whose anchors differ from the weights by `shift`."""
    state = {f"anchor.{n}": v.detach() + shift for n, v in head.named_parameters()}
    return state | {
        f"importance.{n}": torch.full_like(v.detach(), importance)
        for n, v in head.named_parameters()
    }


def cost(method: WeightRegularization, head: Head, states: list[MethodState]) -> float:
    actual = method.begin(stage_start(head, [], states=states)).regularizer()
    return 0.0 if actual is None else float(actual.detach())


def test_cost_by_hand() -> None:
    head = wave_head(1)
    ewc = ElasticWeightConsolidation(strength=7.0)
    assert cost(ewc, head, [tied(head, 3.0)]) == 0.0
    # Two scenes with importances 3 and 1, every weight changed by 0.1.
    states: list[MethodState] = [tied(head, 3.0, 0.1), tied(head, 1.0, -0.1)]
    assert cost(ewc, head, states) == pytest.approx(0.5 * 7 * 4 * 0.01, rel=1e-4)
    # The running form uses the newest state only.
    assert cost(replace(ewc, running=True), head, states) == pytest.approx(0.5 * 7 * 0.01, rel=1e-4)
    assert cost(ewc, head, []) == 0.0


def test_rows_of_later_scenes_are_free() -> None:
    head = wave_head(1)
    state = tied(head, 1.0)
    head.grow(torch.ones(2, 3), seed=1)
    with torch.no_grad():
        head.code[1] += 7
        head.logit[2:] += 7
    ewc = ElasticWeightConsolidation()
    assert cost(ewc, head, [state]) == pytest.approx(0.0)
    with torch.no_grad():
        head.code[0, 0, 0] += 7
    assert cost(ewc, head, [state]) > 0


@pytest.fixture
def finished() -> FinishedScene:
    """The second of two scenes after training."""
    head, buffer = wave_head(2), wave_buffer(1)
    list(HeadTrainer(head, [buffer], OPTIONS, 0).run())
    return FinishedScene(head, 1, lambda: buffer, lambda: buffer, 2, [], None)


def importances(state: dict[str, Tensor]) -> dict[str, Tensor]:
    actual = {k.removeprefix("importance."): v for k, v in state.items() if k.startswith("imp")}
    return {name: value.double() for name, value in actual.items()}


@pytest.mark.parametrize(
    "method", [ElasticWeightConsolidation(), MemoryAwareSynapses()], ids=["ewc", "mas"]
)
def test_unused_parameters_have_no_importance(
    method: WeightRegularization, finished: FinishedScene
) -> None:
    state = method.after_scene(finished)
    actual = importances(state)
    count = sum(value.numel() for value in actual.values())
    assert sum(float(v.sum()) for v in actual.values()) / count == pytest.approx(1, rel=0.02)
    assert all(bool((value >= 0).all()) for value in actual.values())
    assert float(actual["code"][0].abs().max()) == 0.0 < float(actual["code"][1].max())
    own = finished.head.centre_scene == 1
    assert float(actual["logit"][~own].abs().max()) == 0.0 < float(actual["logit"][own].max())
    for name, value in finished.head.named_parameters():
        torch.testing.assert_close(state[f"anchor.{name}"], value.detach().half())


def test_fisher_information_is_the_mean_squared_gradient(finished: FinishedScene) -> None:
    """All rows of the image are equal, so every draw has the same gradient."""
    buffer = wave_buffer(1, views=1, few=1)
    scene = replace(finished, rows=lambda: buffer)
    actual = ElasticWeightConsolidation().importance(scene)
    row = buffer.rows(torch.arange(1))
    points = finished.head(row.features.float(), 1, row.descriptor).points
    loss, _ = reprojection_loss(points, row.target, 5.0, LossOptions())
    named = dict(finished.head.named_parameters())
    exact = torch.autograd.grad(loss.mean(), list(named.values()), materialize_grads=True)
    for (name, _), slope in zip(named.items(), exact, strict=True):
        torch.testing.assert_close(actual[name], slope.square(), rtol=1e-3, atol=1e-7)


def test_running_sums_by_hand(finished: FinishedScene) -> None:
    for method, selected in (
        (ElasticWeightConsolidation(running=True), 0.9),
        (MemoryAwareSynapses(), 1.0),
    ):
        first = method.after_scene(finished)
        second = method.after_scene(replace(finished, earlier=[{"other": torch.zeros(1)}, first]))
        name = "importance.logit"
        expected = first[name].float() * (1 + selected)
        torch.testing.assert_close(second[name].float(), expected, rtol=5e-3, atol=1e-3)
        assert set(second) == set(first)
    # Without a running sum, earlier states are not used.
    plain = ElasticWeightConsolidation()
    alone = plain.after_scene(finished)
    again = plain.after_scene(replace(finished, earlier=[alone]))
    assert all(torch.equal(alone[key], again[key]) for key in alone)


class Linear(torch.nn.Module):
    """Linear points, P = F W'."""

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        self.weight = torch.nn.Parameter(torch.randn(3, 9, generator=generator))

    def points(self, features: Tensor) -> Tensor:
        return features @ self.weight.T


def test_mas_of_a_linear_function_in_closed_form() -> None:
    """|d/dW of the mean |p - mean p|^2| = |2/n sum_i (p_i - mean p) f_i'|, the mean held fixed."""
    buffer, linear = wave_buffer(1, views=1, few=1), Linear()
    # The expected value uses the drawn rows.
    drawn = []

    def length(some) -> Tensor:
        drawn.append(some.features.float())
        points = linear.points(drawn[-1])
        return (points - points.mean(0).detach()).square().sum(-1).mean()

    buffer = wave_buffer(1, views=3)
    actual = mean_over_images(linear, buffer, 10, length, torch.abs)["weight"]  # pyright: ignore[reportArgumentType]
    assert len(drawn) == 3  # every image once
    expected = torch.zeros(3, 9)
    for features in drawn:
        points = linear.points(features).detach()
        away = points - points.mean(0)
        expected += (2 / len(features) * away.T @ features).abs() / 3
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)


def test_mas_does_not_depend_on_the_position_of_the_scene(finished: FinishedScene) -> None:
    """A translation of all centres does not change the importances."""
    method = MemoryAwareSynapses()
    here = method.importance(finished)
    moved = copy.deepcopy(finished.head)
    moved.centres += 7.0
    there = method.importance(replace(finished, head=moved))
    for name in ("first.0.weight", "offset"):
        torch.testing.assert_close(here[name], there[name], rtol=1e-3, atol=1e-5)


def test_path_integral_equals_the_fall_of_a_quadratic_loss() -> None:
    """The sum of -gradient x change over small gradient steps."""
    head = wave_head(1)
    method = SynapticIntelligence()
    hooks = method.begin(stage_start(head, []))
    named = dict(head.named_parameters())
    generator = torch.Generator().manual_seed(5)
    goal = {n: v.detach() + torch.randn(v.shape, generator=generator) for n, v in named.items()}
    curve = {n: 0.1 + torch.rand(v.shape, generator=generator) for n, v in named.items()}

    def loss() -> float:
        return sum(
            float((0.5 * curve[n] * (v.detach() - goal[n]).square()).sum())
            for n, v in named.items()
        )

    def share(name: str) -> Tensor:
        return 0.5 * curve[name] * (named[name].detach() - goal[name]).square()

    first, before = loss(), {name: share(name) for name in named}
    steps, rate = 400, 0.01
    for step in range(steps):
        gradients = {n: curve[n] * (v.detach() - goal[n]) for n, v in named.items()}
        changes = {n: -rate * g for n, g in gradients.items()}
        with torch.no_grad():
            for name, value in named.items():
                value.add_(changes[name])
        hooks.edit_step(ProposedStep(changes, gradients, torch.zeros(0), [], step, 1.0))
    path = {k.removeprefix("path."): v for k, v in hooks.state().items() if k.startswith("path.")}
    fell = sum(float(value.sum()) for value in path.values())
    # The gradient at the start of a step overestimates by at most rate x curvature / 2.
    assert fell == pytest.approx(first - loss(), rel=rate)
    assert first - loss() > 0.3 * first
    # This also holds for each weight.
    name = "first.1.weight"
    torch.testing.assert_close(path[name], before[name] - share(name), rtol=rate, atol=1e-5)


def test_path_importance_by_hand() -> None:
    head = wave_head(1)
    hooks = SynapticIntelligence(damping=0.5).begin(stage_start(head, []))
    named = dict(head.named_parameters())
    changes = {name: torch.zeros_like(value) for name, value in named.items()}
    gradients = {name: torch.zeros_like(value) for name, value in named.items()}
    # One weight moves downhill by 0.2 at a slope of -3, one moves uphill.
    for i, (slope, distance) in enumerate(((-3.0, 0.2), (2.0, 0.1))):
        changes["logit"][0, i], gradients["logit"][0, i] = distance, slope
    with torch.no_grad():
        head.logit.add_(changes["logit"])
    hooks.edit_step(ProposedStep(changes, gradients, torch.zeros(0), [], 0, 1.0))
    actual = hooks.importance(head)  # pyright: ignore[reportAttributeAccessIssue]
    count = sum(value.numel() for value in named.values())
    floor = 0.5 * (0.04 + 0.01) / count
    assert float(actual["logit"][0, 0]) == pytest.approx(0.6 / (0.04 + floor), rel=1e-4)
    assert float(actual["logit"][0, 1]) == 0.0
    assert sum(float(value.sum()) for value in actual.values()) == pytest.approx(
        float(actual["logit"][0, 0])
    )


def test_pull_of_the_ties_is_excluded_from_the_path() -> None:
    """The loss of the new scene is constant, so only the ties change the weights."""
    head = wave_head(1)
    state = tied(head, 1.0, 0.5)
    hooks = SynapticIntelligence(strength=100.0).begin(stage_start(head, [], states=[state]))
    optimiser = torch.optim.SGD(head.parameters(), lr=0.5)
    for step in range(5):
        before = {name: value.detach().clone() for name, value in head.named_parameters()}
        cost = hooks.regularizer()
        assert cost is not None
        optimiser.zero_grad()
        cost.backward()
        gradients = {n: v.grad.clone() for n, v in head.named_parameters() if v.grad is not None}
        optimiser.step()
        changes = {n: v.detach() - before[n] for n, v in head.named_parameters()}
        hooks.edit_step(ProposedStep(changes, gradients, torch.zeros(0), [], step, 1.0))
    path = torch.cat([v.flatten() for k, v in hooks.state().items() if k.startswith("path.")])
    fallen = 0.5 * 100 * 0.25  # initial cost of the ties
    assert float(path.abs().sum()) < 1e-4 * fallen


@pytest.mark.parametrize("method", [ElasticWeightConsolidation(), SynapticIntelligence()])
def test_ties_constrain_the_weights(method: WeightRegularization) -> None:
    moved = []
    for strength in (0.0, 1e5):
        head, old = wave_head(2), wave_head(2)
        state = tied(old, 1.0)
        rule = replace(method, strength=strength)
        hooks = rule.begin(stage_start(head, [], states=[state]))
        list(HeadTrainer(head, [wave_buffer(1)], OPTIONS, 0, hooks).run())
        moved.append(float((flat(head) - flat(old)).norm()))
    assert moved[1] < 0.5 * moved[0]
