"""GPM: bases, and outputs for inputs in the basis."""

import copy

import pytest
import torch
from torch import Tensor

from evercal.continual.methods.method import FinishedScene, MethodState
from evercal.continual.methods.projection import (
    OUTPUTS,
    GradientProjectionMemory,
    grown_basis,
)
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.head import Head, HeadOptions
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.networks.trainer import FitOptions, HeadTrainer

from .by_hand import stage_start, wave_buffer, wave_head

OPTIONS = FitOptions(iterations=60, batch=64, peak_rate=1e-2)


def moment_of(values: list[float], seed: int = 0) -> Tensor:
    """Create an (n, n) matrix with given eigenvalues and random axes."""
    generator = torch.Generator().manual_seed(seed)
    axes = torch.linalg.qr(
        torch.randn(len(values), len(values), generator=generator, dtype=torch.float64)
    ).Q
    return axes @ torch.diag(torch.tensor(values, dtype=torch.float64)) @ axes.T


def held(basis: Tensor, moment: Tensor) -> float:
    """Compute the share of the squared inputs that a basis holds."""
    return float(torch.trace(basis.T @ moment @ basis) / moment.trace())


@pytest.mark.parametrize(
    ("share", "count"), [(0.45, 1), (0.5, 1), (0.55, 2), (0.79, 2), (0.85, 3), (0.97, 4)]
)
def test_new_basis_has_the_fewest_columns(share: float, count: int) -> None:
    moment = moment_of([50.0, 30.0, 10.0, 8.0, 1.5, 0.5])
    actual = grown_basis(torch.zeros(6, 0, dtype=torch.float64), moment, share - 1e-9)
    assert actual.shape == (6, count)
    torch.testing.assert_close(actual.T @ actual, torch.eye(count, dtype=torch.float64))
    # The optimum is the sum of the largest eigenvalues.
    assert held(actual, moment) == pytest.approx(sum([50, 30, 10, 8][:count]) / 100)


@pytest.mark.parametrize("seed", range(5))
def test_grown_basis_contains_the_old_one_and_holds_the_share(seed: int) -> None:
    first, second = (
        moment_of([9.0, 5, 1, 0.1, 0.1, 0.1, 0.01, 0.01], seed),
        moment_of([4.0, 4, 4, 1, 0.2, 0.1, 0.01, 0.01], seed + 50),
    )
    old = grown_basis(torch.zeros(8, 0, dtype=torch.float64), first, 0.9)
    grown = grown_basis(old, second, 0.9)
    count = grown.shape[1]
    assert old.shape[1] < count < 8
    torch.testing.assert_close(grown.T @ grown, torch.eye(count, dtype=torch.float64))
    # The span contains the old basis.
    torch.testing.assert_close(grown @ (grown.T @ old), old)
    assert held(grown, second) >= 0.9 - 1e-9
    # One column fewer would not reach the share.
    free = torch.eye(8, dtype=torch.float64) - old @ old.T
    left = torch.linalg.eigvalsh(free @ second @ free).flip(0)
    fewer = held(old, second) + float(left[: count - old.shape[1] - 1].sum() / second.trace())
    assert fewer < 0.9
    assert torch.equal(grown_basis(grown, second, 0.9), grown)  # the share is reached


def state_of(head: Head, buffer: FeatureBuffer, share: float) -> dict[str, Tensor]:
    scene = FinishedScene(head, 0, lambda: buffer, lambda: buffer, 2, [], None)
    return GradientProjectionMemory(kept_share=share).after_scene(scene)


def exact_state(head: Head, buffer: FeatureBuffer) -> dict[str, Tensor]:
    """Compute the bases in full precision from the singular vectors of the inputs."""
    actual: dict[str, Tensor] = {}
    handles = []
    for name, layer in head.named_modules():
        if isinstance(layer, torch.nn.Linear):

            def look(_: object, inputs: tuple[Tensor, ...], __: object, name: str = name) -> None:
                u, s, _ = torch.linalg.svd(inputs[0].double().T, full_matrices=False)
                actual[f"basis.{name}.weight"] = u[:, s > 1e-6 * s[0]].float()

            handles.append(layer.register_forward_hook(look))
    rows = buffer.rows(torch.arange(len(buffer)))
    with torch.no_grad():
        hidden = head.hidden(rows.features.float(), rows.scene, rows.descriptor)
    u, s, _ = torch.linalg.svd(hidden.double().T, full_matrices=False)
    actual[f"basis.{OUTPUTS}"] = u[:, s > 1e-6 * s[0]].float()
    for handle in handles:
        handle.remove()
    return actual


SHAPES = [
    HeadOptions(width=16, whiten=False),
    HeadOptions(width=16, whiten=False, offsets="shared"),
    HeadOptions(width=16, whiten=False, condition="descriptor"),
    HeadOptions(width=16, whiten=False, condition="descriptor", centres="fixed"),
]


def trained(hooks: TrainingHooks | None, head: Head) -> float:
    """Train on a scene that contradicts the first; return the last loss."""
    new = wave_buffer(1, shift_px=-12.0)
    *_, last = HeadTrainer(head, [new], OPTIONS, 0, hooks).run()
    return float(last.loss)


def two_scenes(options: HeadOptions) -> Head:
    head = wave_head(1, options)
    centres = (
        torch.zeros(0, 3)
        if options.centres == "fixed"
        else torch.tensor([[0.1, 0, 4.0], [0, 0.1, 5.0]])
    )
    head.grow(centres, seed=7)
    return head


@pytest.mark.parametrize("options", SHAPES, ids=lambda o: f"{o.condition}-{o.offsets}-{o.centres}")
def test_output_for_inputs_in_the_basis_is_unchanged(options: HeadOptions) -> None:
    """The old scene has five distinct rows, so the inputs of every layer span five directions."""
    old = wave_buffer(0, few=5)
    rows = old.rows(torch.arange(5))

    def lines(head: Head) -> Tensor:
        # Outputs of the old scene's centres only.
        with torch.no_grad():
            actual = head(rows.features.float(), rows.scene, rows.descriptor)
        return torch.cat([actual.points, actual.offsets[:, 0], actual.logits[:, :2]], 1)

    def drift(state: dict[str, Tensor] | None) -> tuple[float, float, bool]:
        head = two_scenes(options)
        before = copy.deepcopy(head)
        hooks = None
        if state is not None:
            states: list[MethodState] = [state]
            hooks = GradientProjectionMemory().begin(stage_start(head, [], states=states))
        loss = trained(hooks, head)
        moved = not torch.equal(head.first[1].weight, before.first[1].weight)  # pyright: ignore
        return float((lines(head) - lines(before)).abs().max()), loss, moved

    head = two_scenes(options)
    free, _, _ = drift(None)
    exact, loss, moved = drift(exact_state(head, old))
    stored, _, _ = drift(state_of(head, old, 1 - 1e-9))
    assert free > 0.1
    assert exact < 1e-4
    assert stored < 0.02 * free  # bases are stored in half precision
    assert moved
    assert loss < 60  # the new scene is learned


def test_only_directions_of_the_basis_are_removed() -> None:
    head, old = two_scenes(SHAPES[0]), wave_buffer(0, few=5)
    state = state_of(head, old, 0.97)
    before = copy.deepcopy(head)
    states: list[MethodState] = [state]
    trained(GradientProjectionMemory().begin(stage_start(head, [], states=states)), head)
    for name in ("first.0.weight", "blocks.0.1.weight", "last.1.weight"):
        change = (head.get_parameter(name) - before.get_parameter(name)).detach()
        basis = torch.linalg.qr(state[f"basis.{name}"].float()).Q
        assert 0 < basis.shape[1] <= 5
        assert float((change @ basis).norm()) < 1e-4 * float(change.norm())
        assert float(change.norm()) > 0
    # Parameters of the first scene are fixed, those of the second are trained.
    own = head.centre_scene == 0
    for name in ("logit", "logit_bias", "offset", "offset_bias"):
        moved = (head.get_parameter(name) - before.get_parameter(name)).detach()
        moved = moved.abs().flatten(1).sum(1) if moved.ndim > 1 else moved.abs()
        assert float(moved[own].max()) == 0.0 < float(moved[~own].max())
    assert torch.equal(head.code[0], before.code[0])
    assert not torch.equal(head.code[1], before.code[1])


def test_later_basis_contains_earlier_bases() -> None:
    head = wave_head(3)
    method, states = GradientProjectionMemory(kept_share=0.9), []
    for scene in range(2):
        buffer = wave_buffer(scene)
        finished = FinishedScene(
            head, scene, lambda b=buffer: b, lambda b=buffer: b, 2, states, None
        )
        states = [*states, method.after_scene(finished)]
    for name, first in states[0].items():
        second = states[1][name]
        assert first.dtype == torch.half
        assert second.shape[1] >= first.shape[1]
        inside = second.float() @ (second.float().T @ first.float())
        torch.testing.assert_close(inside, first.float(), atol=5e-3, rtol=0)
    assert f"basis.{OUTPUTS}" in states[0]
