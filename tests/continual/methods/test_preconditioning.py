"""Protection: exact in a linear case, less drift of old scenes, and the same after a resumption."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from evercal.continual.methods.preconditioning import GradientPreconditioning, preconditioner
from evercal.networks.buffer import FeatureBuffer, Rows
from evercal.networks.head import Head, HeadOptions, HeadOutput
from evercal.networks.trainer import FitOptions, HeadTrainer, Replay

Learnable = Callable[..., tuple[FeatureBuffer, Tensor]]
OPTIONS = FitOptions(iterations=30, batch=128, replay_batch=128)


def head_of(buffers: list[FeatureBuffer]) -> Head:
    torch.manual_seed(0)
    head = Head(48, 6, HeadOptions(width=32))
    for buffer in buffers:
        matrix = buffer.tensors["camera_from_atlas"][:3].double()
        head.grow((-matrix[:, :, :3].mT @ matrix[:, :, 3:])[..., 0].float(), seed=buffer.scene)
    return head


@pytest.mark.parametrize("scenes", [1, 2])
def test_updates_are_damped_as_the_formula_says(learnable: Learnable, scenes: int) -> None:
    buffers = [learnable(scene)[0] for scene in range(scenes)]
    head, strength = head_of(buffers), 3.0
    seen: list[Tensor] = []
    first = head.first[0]
    assert isinstance(first, torch.nn.Linear)
    hook = first.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0]))
    preconditioning = GradientPreconditioning(head, buffers, strength, seed=4)
    hook.remove()
    moments = [x.double().T @ x.double() / len(x) for x in seen]
    assert len(moments) == scenes
    moment = torch.stack([m / m.diagonal().mean() for m in moments]).sum(0)
    expected = torch.linalg.inv(torch.eye(48) + strength * moment)
    change = torch.randn(32, 48, generator=torch.Generator().manual_seed(2))
    before, bias = first.weight.detach().clone(), first.bias.detach().clone()
    with preconditioning.damped(), torch.no_grad():
        first.weight.add_(change)
        first.bias.add_(1)
    found = first.weight.detach() - before
    torch.testing.assert_close(found.double(), change.double() @ expected, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(first.bias.detach(), bias + 1)
    # A direction that the scene uses moves less than one that it hardly uses.
    _, axes = torch.linalg.eigh(moment)
    kept = [float((found.double() @ a).norm() / (change.double() @ a).norm()) for a in axes.T]
    assert kept[-1] < 0.3 < 0.9 < kept[0]


def test_what_one_remembered_scene_owns_does_not_move(learnable: Learnable) -> None:
    buffers = [learnable(scene)[0] for scene in range(3)]
    head = head_of(buffers)

    def cost(output: HeadOutput, rows: Rows, progress: float) -> Tensor:
        return output.points.abs().mean()

    before = {name: value.clone() for name, value in head.state_dict().items()}
    replay = Replay(buffers[:2], cost, precondition=preconditioner(1e-6))
    list(HeadTrainer(head, buffers[2:], replay, OPTIONS, 0).run())
    after = head.state_dict()
    own = {"code": torch.tensor([True, True, False])}
    for name in ("logit", "logit_bias", "offset", "offset_bias"):
        own[name] = head.centre_scene < 2
    for name, held in own.items():
        changed = (after[name] != before[name]).flatten(1 if after[name].ndim > 1 else 0)
        changed = changed.any(1) if changed.ndim > 1 else changed
        assert not changed[held].any()
        assert changed[~held].any()
    assert (after["last.1.weight"] != before["last.1.weight"]).any()


def test_an_old_scene_drifts_less(learnable: Learnable) -> None:
    old, new = learnable(0)[0], learnable(1)[0]

    def free(output: object, rows: Rows, progress: float) -> Tensor:
        return torch.zeros(())

    drift = {}
    for strength in (0.0, 30.0):
        head = head_of([old, new])
        rows = old.draw(500, torch.Generator().manual_seed(0))
        with torch.no_grad():
            before = head(rows.features.float(), 0, None).points
        list(
            HeadTrainer(
                head, [new], Replay([old], free, precondition=preconditioner(strength)), OPTIONS, 0
            ).run()
        )
        with torch.no_grad():
            after = head(rows.features.float(), 0, None).points
        drift[strength] = float((after - before).norm(dim=-1).median())
    assert 0 < drift[30.0] < 0.6 * drift[0.0]


@pytest.mark.parametrize("stop", [1, 17])
def test_a_resumed_run_protects_the_same_directions(learnable: Learnable, stop: int) -> None:
    old, new = learnable(0)[0], learnable(1)[0]

    def free(output: object, rows: Rows, progress: float) -> Tensor:
        return torch.zeros(())

    def trainer() -> HeadTrainer:
        return HeadTrainer(
            head_of([old, new]),
            [new],
            Replay([old], free, precondition=preconditioner(5.0)),
            OPTIONS,
            0,
        )

    whole, part, rest = trainer(), trainer(), trainer()
    list(whole.run())
    run = part.run()
    for _ in range(stop):
        next(run)
    rest.load(part.state())
    list(rest.run())
    for name, value in whole.head.state_dict().items():
        torch.testing.assert_close(rest.head.state_dict()[name], value, rtol=0, atol=1e-6)
    unprotected = HeadTrainer(head_of([old, new]), [new], Replay([old], free), OPTIONS, 0)
    list(unprotected.run())
    name = "first.1.weight"
    assert not torch.allclose(unprotected.head.state_dict()[name], whole.head.state_dict()[name])
