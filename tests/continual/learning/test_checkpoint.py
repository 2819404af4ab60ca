"""A training that was killed goes on, with the result of one that was not."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from evercal.continual import strategies
from evercal.continual.learning import checkpoint
from evercal.continual.learning.learn import learn, learn_jointly
from evercal.continual.learning.stage import StageOptions
from evercal.continual.methods.ewc import ElasticWeightConsolidation
from evercal.continual.methods.mir import MaximallyInterferedRetrieval
from evercal.continual.networks.trainer import Progress
from evercal.continual.scenes import LearnedScenes
from evercal.continual.strategies import STRATEGIES, load_plugin, strategy_named

from ..stages import EmptyScenes, Rooms, Stages, weights

ALL = [name for name, one in STRATEGIES.items() if one.method and not one.jointly]
Learn = Callable[[Path | None, int], tuple[LearnedScenes, list[Progress]]]


class Killed(Exception):
    """Ends a training."""


@pytest.fixture(autouse=True)
def _every_step(monkeypatch: pytest.MonkeyPatch, quick_disk: None) -> None:
    monkeypatch.setattr(checkpoint, "EVERY_S", -1.0)


def stopped_after(step: int, steps: list[Progress]) -> Callable[[object], None]:
    """An observer that ends the training after a step."""

    def observe(event: object) -> None:
        if isinstance(event, Progress):
            steps.append(event)
            if event.step == step:
                raise Killed

    return observe


@pytest.mark.parametrize("name", ALL)
def test_every_method_goes_on_as_if_nothing_had_happened(
    name: str, first_stages: Stages, rooms: Rooms, quick: StageOptions, tmp_path: Path
) -> None:
    method = STRATEGIES[name].method
    assert method is not None
    start = first_stages[name]
    whole = learn(start, method, rooms[1], quick)
    steps: list[Progress] = []
    for last in (3, 6, 7):
        observe = stopped_after(last, steps)
        with pytest.raises(Killed):
            learn(start, method, rooms[1], quick, observe, tmp_path)
    after = learn(start, method, rooms[1], quick, stopped_after(-1, steps), tmp_path)
    # The checkpoint is written before a step is shown.
    assert [progress.step for progress in steps] == [1, 2, 3, 4, 5, 6, 7, 8]
    for head, other in zip(after.heads, whole.heads, strict=True):
        mine, others = weights(head), weights(other)
        assert all(torch.equal(mine[key], others[key]) for key in others)
    for state, other in zip(after.method_states, whole.method_states, strict=True):
        assert all(torch.equal(state[key], other[key]) for key in other)
    with open(tmp_path / checkpoint.CURVE, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert float(rows[4]["loss"]) == steps[4].loss
    assert float(rows[4]["inlier_share"]) == steps[4].inlier_share
    assert rows[4].keys() == set(checkpoint.COLUMNS)


def test_joint_training_goes_on(
    empty_scenes: EmptyScenes, rooms: Rooms, quick: StageOptions, tmp_path: Path
) -> None:
    empty = empty_scenes("joint")
    whole = learn_jointly(empty, rooms[:2], quick)
    steps: list[Progress] = []
    with pytest.raises(Killed):
        learn_jointly(empty, rooms[:2], quick, stopped_after(9, steps), tmp_path)
    after = learn_jointly(empty, rooms[:2], quick, stopped_after(-1, steps), tmp_path)
    assert [progress.step for progress in steps] == list(range(1, 17))
    mine, others = weights(after.heads[0]), weights(whole.heads[0])
    assert all(torch.equal(mine[key], others[key]) for key in others)


@pytest.mark.parametrize(
    "other", ["seed", "options", "method", "frames", "lens", "damaged"]
)
def test_checkpoint_of_another_training_is_ignored(
    other: str, first_stages: Stages, rooms: Rooms, quick: StageOptions, tmp_path: Path
) -> None:
    start = first_stages["mir"]
    method = MaximallyInterferedRetrieval(weight=0.3)
    with pytest.raises(Killed):
        learn(start, method, rooms[1], quick, stopped_after(5, []), tmp_path)
    file = tmp_path / checkpoint.CHECKPOINT
    room = rooms[1]
    if other == "seed":
        quick = replace(quick, seed=1)
    elif other == "options":
        quick = replace(quick, fit=replace(quick.fit, weight_decay=0.02))
    elif other == "method":
        method = ElasticWeightConsolidation()
        start = first_stages["ewc"]
    elif other == "frames":
        room = replace(room, train=room.train[1:])
    elif other == "lens":
        focal = replace(room.train[0].camera, fx=2 * room.train[0].camera.fx)
        room = replace(room, train=[replace(f, camera=focal) for f in room.train])
    else:
        file.write_bytes(file.read_bytes()[:1000])
    steps: list[Progress] = []
    learn(start, method, room, quick, stopped_after(-1, steps), tmp_path)
    assert steps[0].step == 1


PENALTY = """
from dataclasses import dataclass
from evercal.continual.methods.penalties import Reprojection
from evercal.continual.methods.replay import Replay
from evercal.continual.strategies import Strategy

@dataclass(frozen=True)
class Mine(Reprojection):
    def __call__(self, student, teacher, rows, tau_px):
        return {} * super().__call__(student, teacher, rows, tau_px)

STRATEGIES = {{"mine": Strategy("mine", Replay(penalty=Mine()))}}
"""


def test_checkpoint_of_another_penalty_is_ignored(
    first_stages: Stages,
    rooms: Rooms,
    quick: StageOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The code of a plugin decides a training, not only that of the method which uses it."""
    plugin = tmp_path / "plugin.py"
    first = []
    for factor in (1, 1, 100):
        plugin.write_text(PENALTY.format(factor))
        monkeypatch.setattr(strategies, "STRATEGIES", dict(STRATEGIES))
        load_plugin(plugin)
        method = strategy_named("mine").method
        assert method is not None
        steps: list[Progress] = []
        stop = stopped_after(3 + len(first), steps)
        with pytest.raises(Killed):
            learn(first_stages["er"], method, rooms[1], quick, stop, tmp_path)
        first.append(steps[0].step)
    assert first == [1, 4, 1]
