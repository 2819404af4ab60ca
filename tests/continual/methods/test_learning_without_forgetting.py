"""LwF: new rows with the index of an old scene keep the output of the old head."""

import copy

import pytest
import torch

from evercal.continual.methods.learning_without_forgetting import (
    LearningWithoutForgetting,
)
from evercal.continual.networks.buffer import join
from evercal.continual.networks.head import Head, HeadOutput
from evercal.continual.networks.hooks import TrainingHooks

from ..draws import seeded
from .by_hand import stage_start, wave_buffer, wave_head


def grown(scenes: int) -> tuple[Head, Head]:
    """Create a teacher, and a student with one more scene."""
    teacher = wave_head(scenes)
    student = copy.deepcopy(teacher)
    student.grow(torch.ones(2, 3), seed=9)
    return teacher, student


def calls(hooks: TrainingHooks, scene: int = 9):
    fresh = wave_buffer(scene).draw(32, seeded(0))
    return fresh, hooks.replayed(fresh, 0, 1e-3, seeded(1))


@pytest.mark.parametrize("scenes", [1, 2, 3])
def test_new_rows_are_replayed_with_every_old_scene(scenes: int) -> None:
    teacher, student = grown(scenes)
    start = stage_start(student, [], teacher=teacher, replay_rows=60)
    fresh, parts = calls(LearningWithoutForgetting().begin(start))
    assert [set(part.scene.tolist()) for part in parts] == [{i} for i in range(scenes)]
    for part in parts:
        assert len(part.scene) == 60 // scenes
        new = {tuple(row) for row in fresh.features.tolist()}
        assert {tuple(row) for row in part.features.tolist()} <= new
    assert set(fresh.scene.tolist()) == {9}  # the new rows are unchanged


def test_cost_by_hand() -> None:
    teacher, student = grown(2)
    start = stage_start(student, [], teacher=teacher, replay_rows=60)
    method = LearningWithoutForgetting(weight=0.5, px_per_m=20.0)
    hooks = method.begin(start)
    _, parts = calls(hooks)
    rows = join(parts)
    output = student(rows.features.float(), rows.scene, rows.descriptor)
    actual = hooks.cost(output, rows, 0.3)
    assert actual is not None
    # Some processors use bfloat16.
    assert float(actual.detach()) == pytest.approx(0.0, abs=0.5)
    away = HeadOutput(output.logits, output.offsets, output.points + 0.3, output.hidden)
    actual = hooks.cost(away, rows, 0.3)
    assert actual is not None
    # Loss of each old scene: 0.5 x 20 px/m x (3 x 0.3 m).
    assert float(actual.detach()) == pytest.approx(2 * 0.5 * 20 * 0.9, rel=0.03)
