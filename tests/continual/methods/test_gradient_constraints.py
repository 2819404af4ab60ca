"""How gradients join: by hand in the plane, and by what every rule promises."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from evercal.continual.methods.gradient_constraints import (
    GEC_ALPHA,
    GEC_SLACK,
    GEC_WARM_STEPS,
    averaged_constraint,
    episodic_barrier,
    gem,
    moving_barrier,
)
from evercal.networks.gradients import Gradients


def gradients(
    new: list[float],
    memory: list[list[float]],
    losses: list[float] | None = None,
    references: list[float] | None = None,
    step: int = 100,
    before: list[float] | None = None,
) -> Gradients:
    count = len(memory)
    return Gradients(
        torch.tensor(new),
        torch.tensor(memory),
        torch.tensor(losses or [1.0] * count),
        torch.tensor(references or [1.0] * count),
        torch.tensor(before or [float("nan")] * count),
        step,
    )


def test_what_agrees_is_left_alone() -> None:
    g = gradients([1.0, 1.0], [[1.0, 0.0], [0.0, 1.0]], [1.0, 1.0], [1.0, 1.0])
    for rule in (averaged_constraint, gem, episodic_barrier):
        assert rule(g).tolist() == [1.0, 1.0]


def test_averaged_constraint_by_hand() -> None:
    # The mean of the memory is (0, 1): the part of the new gradient against it goes.
    g = gradients([2.0, -3.0], [[1.0, 1.0], [-1.0, 1.0]])
    torch.testing.assert_close(averaged_constraint(g), torch.tensor([2.0, 0.0]))


def test_gem_by_hand() -> None:
    # Against both axes: the nearest gradient that harms neither is none at all.
    g = gradients([-2.0, -3.0], [[1.0, 0.0], [0.0, 1.0]])
    torch.testing.assert_close(gem(g, margin=0.0), torch.zeros(2), atol=1e-4, rtol=0)
    # The margin favours the memory: 0.5 of each of its gradients is added.
    torch.testing.assert_close(gem(g, margin=0.5), torch.full((2,), 0.5), atol=1e-4, rtol=0)
    one = gradients([2.0, -3.0], [[0.0, 1.0]])
    torch.testing.assert_close(gem(one, margin=0.0), torch.tensor([2.0, 0.0]), atol=1e-4, rtol=0)


def test_the_barrier_by_hand() -> None:
    # One scene, its loss 0.3 above what is allowed: v must fall along it by alpha 0.3.
    g = gradients([2.0, -3.0], [[0.0, 1.0]], [1.0 + GEC_SLACK + 0.3], [1.0])
    expected = torch.tensor([2.0, GEC_ALPHA * 0.3])
    torch.testing.assert_close(episodic_barrier(g), expected, atol=1e-4, rtol=0)
    # Well below its reference it may rise: by alpha 4 the gradient of -3 is harmless... 2 is not.
    for loss, second in ((1.05 - 8.0, -3.0), (1.05 - 4.0, -2.0)):
        g = gradients([2.0, -3.0], [[0.0, 1.0]], [loss], [1.0])
        expected = torch.tensor([2.0, second])
        torch.testing.assert_close(episodic_barrier(g), expected, atol=1e-4, rtol=0)


def test_the_barrier_begins_with_plain_replay_and_needs_a_reference() -> None:
    g = gradients([2.0, -3.0], [[0.0, 1.0], [2.0, 1.0]], step=GEC_WARM_STEPS - 1)
    torch.testing.assert_close(episodic_barrier(g), torch.tensor([3.0, -2.0]))
    unknown = gradients([2.0, -3.0], [[0.0, 1.0]], [5.0], [float("nan")])
    assert episodic_barrier(unknown).tolist() == [2.0, -3.0]


def test_the_moving_barrier_looks_at_the_step_before() -> None:
    # Far above what the scene had when it was learned, but just as much as a step ago.
    g = gradients([2.0, -3.0], [[0.0, 1.0]], [9.0], [1.0], before=[9.0])
    expected = torch.tensor([2.0, -GEC_ALPHA * GEC_SLACK * 9.0])
    torch.testing.assert_close(moving_barrier(g), expected, atol=1e-4, rtol=0)
    assert moving_barrier(g)[1] < 0 < episodic_barrier(g)[1]
    first = gradients([2.0, -3.0], [[0.0, 1.0]], [9.0], [1.0])
    assert moving_barrier(first).tolist() == [2.0, -3.0]


def nearest(g: Gradients, bound: Tensor) -> np.ndarray:
    """The quadratic programme solved by another road."""
    new, memory = g.new.double().numpy(), g.memory.double().numpy()
    found = minimize(
        lambda v: 0.5 * ((v - new) ** 2).sum(),
        new,
        jac=lambda v: v - new,
        constraints={"type": "ineq", "fun": lambda v: memory @ v - bound.numpy()},
        tol=1e-9,
    )
    assert found.success
    return found.x


@pytest.mark.parametrize("seed", range(6))
def test_rules_give_the_nearest_gradient_that_is_allowed(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    count = 1 + seed % 4
    g = Gradients(
        torch.randn(7, generator=generator),
        torch.randn(count, 7, generator=generator),
        1 + torch.rand(count, generator=generator),
        1 + torch.rand(count, generator=generator),
        torch.full((count,), torch.nan),
        50,
    )
    zero = torch.zeros(count)
    np.testing.assert_allclose(gem(g, margin=0.0), nearest(g, zero), atol=2e-4)
    bound = GEC_ALPHA * (g.losses - (1 + GEC_SLACK) * g.references)
    np.testing.assert_allclose(episodic_barrier(g), nearest(g, bound), atol=2e-4)


def test_parallel_constraints_have_an_answer() -> None:
    g = gradients([0.0, -1.0], [[0.0, 1.0], [0.0, 1.0], [0.0, 2.0]])
    torch.testing.assert_close(gem(g, margin=0.0), torch.zeros(2), atol=1e-3, rtol=0)
