"""EWC: cost and importances against closed forms."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from evercal.continual.methods.ewc import ElasticWeightConsolidation, fisher_information
from evercal.continual.methods.method import FinishedScene, MethodState
from evercal.continual.networks.head import Head
from evercal.continual.networks.loss import LossOptions, reprojection_loss
from evercal.continual.networks.trainer import FitOptions, HeadTrainer

from .by_hand import rows, stage_start, wave_buffer, wave_head

OPTIONS = FitOptions(iterations=8, batch=64, peak_rate=1e-2)


def tied(head: Head, importance: float, shift: float = 0.0) -> dict[str, Tensor]:
    """Create a state whose anchors differ from the weights by `shift`."""
    state = {f"anchor.{n}": v.detach() + shift for n, v in head.named_parameters()}
    return state | {
        f"importance.{n}": torch.full_like(v.detach(), importance)
        for n, v in head.named_parameters()
    }


def cost(
    method: ElasticWeightConsolidation, head: Head, states: list[MethodState]
) -> float:
    hooks = method.begin(stage_start(head, [], states=states))
    output = head(torch.zeros(0, 9), 0, torch.zeros(0, 4))
    actual = hooks.cost(output, rows(0), tau_px=5.0)
    return 0.0 if actual is None else float(actual.detach())


def test_cost_by_hand() -> None:
    head = wave_head(1)
    ewc = ElasticWeightConsolidation(strength=7.0)
    assert cost(ewc, head, [tied(head, 3.0)]) == 0.0
    # Two scenes with importances 3 and 1, every weight changed by 0.1.
    states: list[MethodState] = [tied(head, 3.0, 0.1), tied(head, 1.0, -0.1)]
    assert cost(ewc, head, states) == pytest.approx(0.5 * 7 * 4 * 0.01, rel=1e-4)
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
    head = wave_head(2)
    buffer = wave_buffer(1)
    list(HeadTrainer(head, [buffer], OPTIONS, 0).run())
    return FinishedScene(head, 1, lambda: buffer, lambda: buffer)


def importances(state: dict[str, Tensor]) -> dict[str, Tensor]:
    actual = {
        k.removeprefix("importance."): v
        for k, v in state.items()
        if k.startswith("imp")
    }
    return {name: value.double() for name, value in actual.items()}


def test_unused_parameters_have_no_importance(finished: FinishedScene) -> None:
    state = ElasticWeightConsolidation().after_scene(finished)
    actual = importances(state)
    count = sum(value.numel() for value in actual.values())
    assert sum(float(v.sum()) for v in actual.values()) / count == pytest.approx(
        1, rel=0.02
    )
    assert all(bool((value >= 0).all()) for value in actual.values())
    assert float(actual["code"][0].abs().max()) == 0.0 < float(actual["code"][1].max())
    own = finished.head.centre_scene == 1
    assert (
        float(actual["logit"][~own].abs().max())
        == 0.0
        < float(actual["logit"][own].max())
    )
    for name, value in finished.head.named_parameters():
        torch.testing.assert_close(state[f"anchor.{name}"], value.detach().half())


def test_fisher_information_is_the_mean_squared_gradient(
    finished: FinishedScene,
) -> None:
    """All rows of the image are equal, so every draw has the same gradient."""
    buffer = wave_buffer(1, views=1, few=1)
    scene = replace(finished, rows=lambda: buffer)
    actual = fisher_information(scene, 200)
    row = buffer.rows(torch.arange(1))
    points = finished.head(row.features.float(), 1, row.descriptor).points
    loss, _ = reprojection_loss(points, row.target, 5.0, LossOptions())
    named = dict(finished.head.named_parameters())
    exact = torch.autograd.grad(
        loss.mean(), list(named.values()), materialize_grads=True
    )
    for (name, _), slope in zip(named.items(), exact, strict=True):
        torch.testing.assert_close(actual[name], slope.square(), rtol=1e-3, atol=1e-7)
