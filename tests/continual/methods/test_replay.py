"""Replay: division of rows, weights, and stored points."""

import copy

import pytest
import torch
from torch import Tensor

from evercal.continual.methods.penalties import OldOutput, Reprojection
from evercal.continual.methods.replay import Replay, ReplayHooks
from evercal.continual.networks.buffer import Rows, join
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.hooks import TrainingHooks

from ..draws import seeded
from .by_hand import Given, head_output, off_by, stage_start, wave_buffer, wave_head


def one_each(output: HeadOutput, rows: Rows) -> Tensor:
    """A constant loss of one per row."""
    return torch.ones(len(rows.scene)).mean()


def drawn(hooks: TrainingHooks, step: int = 0) -> list[Rows]:
    fresh = wave_buffer(9).draw(8, seeded(0))
    return hooks.replayed(fresh, step, 1e-3, seeded(step))


@pytest.mark.parametrize("scenes", [1, 2, 3, 6])
def test_weight_is_one_for_all_scenes(scenes: int) -> None:
    method = Replay(penalty=Given(one_each), weight=0.3)
    memories = [wave_buffer(i) for i in range(scenes)]
    hooks = method.begin(stage_start(wave_head(scenes + 1), memories))
    replayed = join(drawn(hooks))
    cost = hooks.cost(head_output([off_by(0.0)] * len(replayed.scene)), replayed, 0.0)
    assert float(cost or 0) == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("scenes", "each"), [(1, 60), (2, 30), (3, 20), (4, 15), (7, 8), (90, 1)]
)
def test_replayed_rows_are_divided_among_scenes(scenes: int, each: int) -> None:
    memories = [wave_buffer(i % 4) for i in range(scenes)]
    start = stage_start(wave_head(4), memories, replay_rows=60)
    hooks = Replay().begin(start)
    for step in range(3):
        parts = drawn(hooks, step)
        assert [len(part.scene) for part in parts] == [each] * scenes
        assert [set(part.scene.tolist()) for part in parts] == [
            {i % 4} for i in range(scenes)
        ]
    assert sum(len(part.scene) for part in drawn(hooks)) <= max(60, scenes)


def test_first_scene_has_no_replay() -> None:
    hooks = Replay().begin(stage_start(wave_head(1), []))
    assert type(hooks) is TrainingHooks
    assert drawn(hooks) == []


def test_teacher_runs_only_if_needed() -> None:
    head = wave_head(2)
    start = stage_start(head, [wave_buffer(0)], teacher=copy.deepcopy(head))
    assert start.teacher is not None
    calls = []
    start.teacher.register_forward_hook(lambda *_: calls.append(1))
    output = head_output([off_by(1.0)] * 2)
    some = wave_buffer(0).rows(torch.arange(2))
    for penalty, times in ((Reprojection(), 0), (OldOutput(), 1)):
        hooks = Replay(penalty=penalty).begin(start)
        assert isinstance(hooks, ReplayHooks)
        hooks.cost(output, some, 0.5)
        assert len(calls) == times
