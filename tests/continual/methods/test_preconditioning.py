"""Preconditioned steps: the formula, fixed parameters, less drift."""

import pytest
import torch
from torch import Tensor

from evercal.continual.methods.preconditioning import PreconditionedReplay, owned_rows
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.head import Head, HeadOptions
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks
from evercal.continual.networks.trainer import FitOptions, HeadTrainer

from ..box_features import Learnable, head_at_cameras
from ..draws import normal
from .by_hand import Cost, Given, stage_start, wave_buffer, wave_head

OPTIONS = FitOptions(iterations=30, batch=128, replay_batch=128)


def hooks_for(head: Head, memories: list[FeatureBuffer], cost: Cost, strength: float):
    method = PreconditionedReplay(penalty=Given(cost), strength=strength)
    return method.begin(stage_start(head, memories, replay_rows=128))


def edited(
    hooks: TrainingHooks, head: Head, changes: dict[str, Tensor]
) -> dict[str, Tensor]:
    zero = {name: torch.zeros_like(value) for name, value in head.named_parameters()}
    proposed = ProposedStep(zero | changes, torch.zeros(0), [], 0, 1.0)
    hooks.edit_step(proposed)
    return proposed.changes


@pytest.mark.parametrize("scenes", [1, 2])
def test_changes_are_damped_by_the_formula(learnable: Learnable, scenes: int) -> None:
    buffers = [learnable(scene)[0] for scene in range(scenes)]
    head = head_at_cameras(buffers)
    strength = 3.0
    captured: list[Tensor] = []
    first = head.first[0]
    assert isinstance(first, torch.nn.Linear)
    hook = first.register_forward_hook(lambda _, inputs, __: captured.append(inputs[0]))
    hooks = hooks_for(head, buffers, lambda *_: torch.zeros(()), strength)
    hook.remove()
    moments = [x.double().T @ x.double() / len(x) for x in captured]
    assert len(moments) == scenes
    moment = torch.stack([m / m.diagonal().mean() for m in moments]).sum(0)
    expected = torch.linalg.inv(torch.eye(48) + strength * moment)
    change = normal(32, 48, seed=2)
    bias = torch.ones(32)
    actual = edited(
        hooks, head, {"first.0.weight": change.clone(), "first.0.bias": bias.clone()}
    )
    damped = actual["first.0.weight"]
    torch.testing.assert_close(
        damped.double(), change.double() @ expected, atol=1e-4, rtol=1e-4
    )
    torch.testing.assert_close(actual["first.0.bias"], bias)
    # The main input direction is damped more than the least used one.
    _, axes = torch.linalg.eigh(moment)
    selected = [
        float((damped.double() @ a).norm() / (change.double() @ a).norm())
        for a in axes.T
    ]
    assert selected[-1] < 0.3 < 0.9 < selected[0]


@pytest.mark.parametrize("strength", [0.0, 0.5])
def test_parameters_of_remembered_scenes_are_fixed(
    learnable: Learnable, strength: float
) -> None:
    buffers = [learnable(scene)[0] for scene in range(3)]
    head = head_at_cameras(buffers)
    before = {name: value.clone() for name, value in head.state_dict().items()}
    # The mean length of points depends on all parameters.
    hooks = hooks_for(
        head, buffers[:2], lambda output, _: output.points.abs().mean(), strength
    )
    list(HeadTrainer(head, buffers[2:], OPTIONS, 0, hooks).run())
    after = head.state_dict()
    own = {"code": torch.tensor([True, True, False])}
    for name in ("logit", "logit_bias", "offset", "offset_bias"):
        own[name] = head.centre_scene < 2
    for name, held in own.items():
        changed = (after[name] != before[name]).flatten(
            1 if after[name].ndim > 1 else 0
        )
        changed = changed.any(1) if changed.ndim > 1 else changed
        assert not changed[held].any()
        assert changed[~held].any()
    assert (after["last.1.weight"] != before["last.1.weight"]).any()


def test_shared_centres_are_trained() -> None:
    """With fixed centres, all scenes share the centres of the first stage."""
    options = HeadOptions(
        width=16, condition="descriptor", centres="fixed", whiten=False
    )
    head = wave_head(1, options)
    head.grow(torch.zeros(0, 3), seed=1)
    assert owned_rows(head, [wave_buffer(0)]) == {}
