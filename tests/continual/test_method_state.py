"""Notes about finished scenes: what weights are worth, what was said, how well it went."""

import math

import pytest
import torch
from torch import Tensor

from evercal.continual.learn import Stage, StageOptions, learn
from evercal.continual.method_state import (
    EWC_STRENGTH,
    FISHER_DECAY,
    FinishedScene,
    after_scene_fisher,
    after_scene_fisher_online,
    after_scene_points,
    after_scene_reference,
    ewc_online_penalty,
    ewc_penalty,
)
from evercal.networks.buffer import FeatureBuffer, encode_frames
from evercal.networks.head import Head, HeadOptions
from evercal.networks.loss import FIXED_CLAMP_PX, LossOptions, reprojection_loss

from .stages import Blank, Rooms


@pytest.fixture(scope="module")
def finished(blank: Blank, rooms: Rooms, quick: StageOptions) -> FinishedScene:
    """Two rooms were learned; the second is noted."""
    maps = blank("finetune")
    for scene in rooms[:2]:
        *_, stage = learn(maps, scene, quick)
        assert isinstance(stage, Stage)
        maps = stage.maps
    buffer = FeatureBuffer(1, maps.scenes[1].cell.atlas_from_base)
    list(encode_frames(buffer, rooms[1].train[:6], quick.encode, maps.encoder, maps.descriptor))
    return FinishedScene(maps.heads[0].eval(), buffer, lambda: buffer, [])


def tiny() -> Head:
    torch.manual_seed(0)
    head = Head(4, 4, HeadOptions(width=4, blocks=1, centres_per_scene=2))
    head.grow(torch.zeros(2, 3), seed=0)
    return head


def anchored(head: Head, fisher: float, shift: float = 0.0) -> dict[str, Tensor]:
    method_states = {f"anchor.{n}": (v.detach() + shift) for n, v in head.named_parameters()}
    return method_states | {
        f"fisher.{n}": torch.full_like(v.detach(), fisher) for n, v in head.named_parameters()
    }


def test_elastic_by_hand() -> None:
    head = tiny()
    assert float(ewc_penalty(head, [anchored(head, 3.0)]).detach()) == 0.0
    # Every weight 0.1 away, F = 3 once and 1 once: 1/2 strength (3 + 1) 0.01, a mean over weights.
    method_states = [anchored(head, 3.0, 0.1), anchored(head, 1.0, -0.1)]
    expected = 0.5 * EWC_STRENGTH * 4 * 0.01
    assert float(ewc_penalty(head, method_states).detach()) == pytest.approx(expected, rel=1e-3)
    online = ewc_online_penalty(head, method_states)
    assert float(online.detach()) == pytest.approx(expected / 4, rel=1e-3)


def test_rows_of_later_scenes_are_free() -> None:
    head = tiny()
    method_states = anchored(head, 1.0)
    head.grow(torch.ones(2, 3), seed=1)
    with torch.no_grad():
        head.code[1] += 7
        head.logit[2:] += 7
    assert float(ewc_penalty(head, [method_states]).detach()) == pytest.approx(0.0)
    with torch.no_grad():
        head.code[0, 0, 0] += 7
    assert float(ewc_penalty(head, [method_states]).detach()) > 0


def test_the_fisher_matrix_has_mean_one_and_ignores_what_the_scene_does_not_use(
    finished: FinishedScene,
) -> None:
    method_states = after_scene_fisher(finished)
    fisher = {
        n.removeprefix("fisher."): v for n, v in method_states.items() if n.startswith("fisher.")
    }
    count = sum(value.numel() for value in fisher.values())
    assert sum(float(v.double().sum()) for v in fisher.values()) / count == pytest.approx(
        1, rel=0.02
    )
    assert all(bool((value >= 0).all()) for value in fisher.values())
    assert float(fisher["code"][0].abs().max()) == 0.0 < float(fisher["code"][1].max())
    own = finished.head.centre_scene == 1
    assert float(fisher["logit"][~own].abs().max()) == 0.0 < float(fisher["logit"][own].max())
    for name, value in finished.head.named_parameters():
        torch.testing.assert_close(method_states[f"anchor.{name}"], value.detach().half())


def test_the_running_sum_fades(finished: FinishedScene) -> None:
    first = after_scene_fisher_online(finished)
    again = FinishedScene(finished.head, finished.buffer, finished.remembered, [first])
    second = after_scene_fisher_online(again)
    name = "fisher.logit"
    expected = first[name].float() * (1 + FISHER_DECAY)
    torch.testing.assert_close(second[name].float(), expected, rtol=5e-3, atol=1e-3)
    assert set(second) == set(first)


def test_points_are_what_the_head_says_to_a_millimetre(finished: FinishedScene) -> None:
    method_states, buffer = after_scene_points(finished), finished.buffer
    rows = buffer.rows(torch.arange(len(buffer)))
    with torch.no_grad():
        said = finished.head(rows.features.float(), 1, rows.descriptor).points
    kept = method_states["points"].float() + method_states["origin"]
    spread = (said - said.mean(0)).abs().max()
    torch.testing.assert_close(kept, said, atol=float(spread) * 2**-10, rtol=0)
    buffer.stored = kept[:50]
    some = buffer.rows(torch.tensor([3, 60]))
    assert some.stored is not None
    torch.testing.assert_close(some.stored[0], kept[3])
    assert math.isnan(float(some.stored[1, 0]))
    buffer.stored = None


def test_the_reference_is_a_loss_at_a_fixed_clamp(finished: FinishedScene) -> None:
    buffer = finished.buffer
    rows = buffer.rows(torch.arange(len(buffer)))
    with torch.no_grad():
        points = finished.head(rows.features.float(), 1, rows.descriptor).points
        loss, _ = reprojection_loss(points, rows.target, FIXED_CLAMP_PX, LossOptions())
    found = float(after_scene_reference(finished)["reference"])
    # 8,192 rows are drawn with replacement.
    assert found == pytest.approx(float(loss.mean()), abs=5 * float(loss.std()) / 90)


@pytest.mark.parametrize("strategy", ["gec", "der", "ewc", "ewc_online"])
def test_notes_reach_the_next_stage_and_count_as_memory(
    strategy: str, blank: Blank, rooms: Rooms, quick: StageOptions
) -> None:
    maps: list = [blank(strategy)]
    for scene in rooms[:2]:
        *_, stage = learn(maps[-1], scene, quick)
        assert isinstance(stage, Stage)
        maps.append(stage.maps)
    assert [len(k.method_states) for k in maps] == [0, 1, 2]
    assert maps[2].memory_bytes > sum(m.bytes for m in maps[2].keyframes if m is not None)
    if strategy.startswith("ewc"):
        # Without its notes the second stage ends elsewhere.
        forgetful = maps[1].copy_for_training()
        forgetful.method_states = []
        *_, stage = learn(forgetful, rooms[1], quick)
        assert isinstance(stage, Stage)
        ends = [k.heads[0].state_dict()["logit"] for k in (maps[2], stage.maps)]
        assert not torch.equal(*ends)
