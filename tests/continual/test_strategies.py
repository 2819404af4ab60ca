"""The rules of the strategies, on rows small enough to do by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual import strategies
from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.methods.penalties import (
    OUTPUT_WEIGHT_PX_PER_M,
    RELATION_TEMPERATURE,
    REPLAY_CLAMP_PX,
    REPLAY_WEIGHT,
    TEACHER_LIMIT_PX,
    anchored_reprojection,
    bounded_by_teacher,
    fixed_clamp_reprojection,
    old_output,
    relations,
    reprojection,
    stored_output,
)
from evercal.continual.methods.spdd import SpddOptions, spdd_loss
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.datasets.frame import Frame
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.networks.buffer import FeatureBuffer, Rows
from evercal.networks.head import Head, HeadOptions, HeadOutput
from evercal.networks.loss import Target

DEPTH_M, FOCAL_PX = 2.0, 100.0
IDLE = SE3.identity()
SELECTING = [name for name, strategy in STRATEGIES.items() if strategy.select is not None]
REPLAYING = [name for name, strategy in STRATEGIES.items() if strategy.penalty is not None]


class Known(FrameStatistics):
    """Frames of a camera that moves by random steps; what a head would say is made up."""

    def __init__(self, positions: np.ndarray, quaternions: np.ndarray):
        camera, image = Camera(8, 8, 8, 8, 3.5, 3.5), np.zeros((8, 8, 3), np.uint8)
        frames = [
            Frame(f"{i}", image, camera, SE3(quaternions[i], positions[i]))
            for i in range(len(positions))
        ]
        super().__init__(
            frames, Head(4, 4, HeadOptions(width=4)), lambda: FeatureBuffer(0, IDLE), 0
        )
        self._made_up = np.random.default_rng(7).normal(size=(len(positions), 40))

    def features(self) -> np.ndarray:
        return self._made_up

    def gradients(self) -> np.ndarray:
        return self._made_up

    def visible_parts(self) -> list[np.ndarray]:
        return [np.flatnonzero(row > 1) for row in self._made_up]


def rows(count: int) -> Rows:
    """Rows seen by a camera at the origin, each of which must project to the image centre."""
    target = Target(
        torch.full((count, 2), 50.0),
        torch.tensor([FOCAL_PX, FOCAL_PX, 50.0, 50.0]).repeat(count, 1),
        torch.eye(4)[:3].repeat(count, 1, 1),
    )
    zero = torch.zeros(count, dtype=torch.long)
    truth = torch.tensor([off_by(0.0)] * count)
    return Rows(torch.zeros(count, 1), zero, torch.zeros(count, 1), target, zero, truth)


def says(points: list[list[float]], hidden: list[list[float]] | None = None) -> HeadOutput:
    """A head's output with these points (camera frame, metres)."""
    where = torch.tensor(points, requires_grad=True)
    zero = torch.zeros(len(points), 2)
    if hidden is not None:
        return HeadOutput(zero, torch.zeros(len(points), 1, 3), where, torch.tensor(hidden))
    return HeadOutput(zero, torch.zeros(len(points), 1, 3), where, zero)


def off_by(pixels: float) -> list[float]:
    """A point that projects `pixels` to the right of where it must."""
    return [pixels / FOCAL_PX * DEPTH_M, 0.0, DEPTH_M]


def test_anchored_reprojection_by_hand() -> None:
    # Row 0: the teacher is right, the student 3 px (6 cm) off: it pays for both.
    # Row 1: the teacher is far off, the student right: it pays nothing, however far they are apart.
    teacher = says([off_by(0.0), off_by(4 * TEACHER_LIMIT_PX)])
    student = says([off_by(3.0), off_by(0.0)])
    cost = anchored_reprojection(student, teacher, rows(2), 0.5)
    tau = REPLAY_CLAMP_PX
    expected = tau * math.tanh(3.0 / tau) / 2 + OUTPUT_WEIGHT_PX_PER_M * 0.06 / 2
    assert float(cost.detach()) == pytest.approx(REPLAY_WEIGHT * expected, rel=1e-5)


def test_depth_that_no_pixel_sees_is_held_by_a_teacher_who_is_right() -> None:
    student, right = says([[0.0, 0.0, DEPTH_M + 0.1]]), says([off_by(0.0)])
    wrong = says([off_by(2 * TEACHER_LIMIT_PX)])
    held = anchored_reprojection(student, right, rows(1), 0.0)
    free = anchored_reprojection(student, wrong, rows(1), 0.0)
    expected = REPLAY_WEIGHT * OUTPUT_WEIGHT_PX_PER_M * 0.1
    assert float(held.detach()) == pytest.approx(expected, rel=1e-5)
    assert float(free.detach()) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("progress", "tau"), [(0.0, 100.0), (1.0, 1.0)])
def test_plain_replay_costs_what_new_rows_cost(progress: float, tau: float) -> None:
    cost = reprojection(says([off_by(3.0), off_by(0.0)]), says([off_by(9.0)]), rows(2), progress)
    assert float(cost.detach()) == pytest.approx(tau * math.tanh(3.0 / tau) / 2, rel=1e-5)


def test_old_output_by_hand() -> None:
    # The student is 3 px (6 cm) right of the truth, the teacher 2 px (4 cm) left of it.
    cost = old_output(says([off_by(3.0)]), says([off_by(-2.0)]), rows(1), 1.0)
    expected = math.tanh(3.0) + OUTPUT_WEIGHT_PX_PER_M * 0.10
    assert float(cost.detach()) == pytest.approx(expected, rel=1e-5)


def test_a_teacher_bounds_only_who_is_worse_than_it() -> None:
    # Row 0: student 3 px, teacher 1 px off: pulled by 4 cm. Row 1: the teacher is worse: free.
    student = says([off_by(3.0), off_by(1.0)])
    teacher = says([off_by(1.0), off_by(2.0)])
    cost = bounded_by_teacher(student, teacher, rows(2), 1.0)
    truth = (math.tanh(3.0) + math.tanh(1.0)) / 2
    expected = 0.5 * truth + 0.5 * OUTPUT_WEIGHT_PX_PER_M * 0.04 / 2
    assert float(cost.detach()) == pytest.approx(expected, rel=1e-5)


def test_stored_output_by_hand() -> None:
    # Two rows 3 px (6 cm) off; what was said of the first is the truth, of the second nothing.
    told = rows(2)
    assert told.stored is not None
    told.stored[1] = torch.nan
    cost = stored_output(says([off_by(3.0)] * 2), says([off_by(9.0)] * 2), told, 1.0)
    expected = 0.5 * math.tanh(3.0) + 0.5 * OUTPUT_WEIGHT_PX_PER_M * 0.06
    assert float(cost.detach()) == pytest.approx(expected, rel=1e-5)


def test_relations_by_hand() -> None:
    # To the teacher rows 0 and 1 are alike and row 2 differs; the student has 1 and 2 alike.
    right = [off_by(0.0)] * 3
    teacher = says(right, [[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    student = says(right, [[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    near = 1 / (1 + math.exp(-1 / RELATION_TEMPERATURE))
    # Row 0: teacher near and far, student halves. Row 1: swapped. Row 2: halves, student far, near.
    row_0 = near * math.log(2 * near) + (1 - near) * math.log(2 * (1 - near))
    row_1 = near * math.log(near / (1 - near)) + (1 - near) * math.log((1 - near) / near)
    row_2 = -0.5 * (math.log(2 * near) + math.log(2 * (1 - near)))
    cost = relations(student, teacher, rows(3), 1.0)
    assert float(cost.detach()) == pytest.approx((row_0 + row_1 + row_2) / 3, rel=1e-4)
    assert float(relations(teacher, teacher, rows(3), 1.0).detach()) == pytest.approx(0, abs=1e-6)


def test_a_steady_clamp_does_not_follow_the_schedule() -> None:
    costs = [
        float(
            fixed_clamp_reprojection(says([off_by(3.0)]), says([off_by(9.0)]), rows(1), t).detach()
        )
        for t in (0.0, 1.0)
    ]
    tau = REPLAY_CLAMP_PX
    assert costs == pytest.approx([tau * math.tanh(3.0 / tau)] * 2, rel=1e-5)


def test_a_teacher_behind_the_camera_holds_nothing() -> None:
    behind = says([[0.0, 0.0, -DEPTH_M]])  # projects to the very pixel, if one divides blindly
    cost = anchored_reprojection(says([off_by(0.0)]), behind, rows(1), 0.0)
    assert float(cost.detach()) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("name", REPLAYING)
def test_the_teacher_is_frozen_and_agreement_with_the_truth_is_free(name: str) -> None:
    penalty = STRATEGIES[name].penalty
    assert penalty is not None
    teacher, student = says([off_by(0.0)] * 3), says([off_by(1.0)] * 3)
    cost = penalty(student, teacher, rows(3), 0.3)
    cost.backward()
    assert student.points.grad is not None
    assert bool((student.points.grad[:, 0] > 0).all())  # back towards the truth
    assert teacher.points.grad is None
    same = penalty(says([off_by(0.0)] * 3), teacher, rows(3), 0.3)
    assert float(same.detach()) == pytest.approx(0.0, abs=1e-6)
    assert float(cost.detach()) > 1e-3


def test_the_papers_penalty_is_spdd_with_its_defaults() -> None:
    generator = torch.Generator().manual_seed(0)

    def output(centres: int) -> HeadOutput:
        def draw(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator)

        return HeadOutput(draw(5, centres), draw(5, centres, 3), draw(5, 3), draw(5, 4))

    teacher, student = output(6), output(8)
    for name in ("sars_spdd", "sars_spdd_filled"):
        penalty = STRATEGIES[name].penalty
        assert penalty is not None
        expected = spdd_loss(student, teacher, SpddOptions()).total
        torch.testing.assert_close(penalty(student, teacher, rows(5), 0.7), expected)


@pytest.mark.parametrize("count", [10, 37, 100, 256])
@pytest.mark.parametrize("name", SELECTING)
def test_no_selection_exceeds_its_capacity(name: str, count: int) -> None:
    rng = np.random.default_rng(count)
    positions = np.cumsum(rng.normal(0, 0.05, (count, 3)), axis=0)
    turns = np.array([1.0, 0, 0, 0]) + np.cumsum(rng.normal(0, 0.1, (count, 4)), axis=0)
    quaternions = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    select = STRATEGIES[name].select
    assert select is not None
    capacity = count // 10
    kept = select(Known(positions, quaternions), capacity)
    assert 1 <= len(kept) <= capacity
    assert np.issubdtype(kept.dtype, np.integer)
    assert (np.diff(kept) > 0).all()
    assert kept[0] >= 0
    assert kept[-1] < count


def test_only_the_papers_own_radius_leaves_memory_unused() -> None:
    # A camera that moves little relative to its turning stays within r = 0.5 of few frames.
    positions = np.linspace(0, 1, 200)[:, None] * [1.0, 0, 0]
    quaternions = np.tile([1.0, 0, 0, 0], (200, 1))
    kept = {}
    for name in SELECTING:
        select = STRATEGIES[name].select
        assert select is not None
        kept[name] = len(select(Known(positions, quaternions), 20))
    assert kept.pop("sars_spdd") < 20
    assert set(kept.values()) == {20}


@pytest.mark.parametrize(("name", "strategy"), STRATEGIES.items())
def test_every_strategy_says_where_it_is_from_and_hangs_together(
    name: str, strategy: Strategy
) -> None:
    assert name.isidentifier()
    assert len(strategy.source.split()) >= 4
    # What is remembered is replayed or recalled, and nothing is that was not remembered.
    assert (strategy.select is None) == (strategy.penalty is None and not strategy.build_map)
    if strategy.data == "all" or strategy.heads == "per_scene":
        assert strategy.penalty is None


def test_fine_tuning_differs_from_our_network_in_replay_alone() -> None:
    ours, control = STRATEGIES["evercal_network"], STRATEGIES["finetune"]
    assert control.select is None
    assert control.penalty is None
    for field in ("data", "heads", "network", "build_map"):
        assert getattr(ours, field) == getattr(control, field)


def test_the_three_of_ours_are_a_map_a_network_and_both() -> None:
    ours, network, both = (STRATEGIES[f"evercal{tail}"] for tail in ("", "_network", "_hybrid"))
    assert [(s.build_map, s.network) for s in (ours, network, both)] == [
        (True, False),
        (False, True),
        (True, True),
    ]
    # What would teach a network is not there where none is taught.
    assert ours == Strategy(ours.source, ours.select, build_map=True, network=False)
    assert replace(both, source=network.source, build_map=False) == network
    assert ours.select == network.select


def test_any_selector_goes_with_any_penalty(monkeypatch: pytest.MonkeyPatch) -> None:
    known = dict(STRATEGIES)
    monkeypatch.setattr(strategies, "STRATEGIES", known)
    made = strategies.compose("sars_filled+spdd")
    ours = STRATEGIES["sars_spdd_filled"]
    assert (made.select, made.penalty) == (ours.select, ours.penalty)
    assert known["sars_filled+spdd"] is made
    assert strategies.compose("sars_filled+spdd") is made
    plain = strategies.compose("reservoir+reprojection")
    assert plain == replace(STRATEGIES["er"], source=plain.source)
    assert not plain.build_map
    recalled = strategies.compose("sars_filled+anchored+recall")
    assert recalled.build_map
    assert recalled.select == STRATEGIES["evercal"].select
    for name in (
        "nonsense",
        "sars+",
        "sars+spdd+",
        "sars+spdd+recall+recall",
        "sars+spdd+more",
        "sars+nonsense",
        "+spdd",
        "nonsense+spdd",
    ):
        with pytest.raises(InputError, match=r"unknown; choose from evercal.* SELECTOR\+PENALTY"):
            strategies.compose(name)


def test_a_name_may_say_how_much_a_rule_weighs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strategies, "STRATEGIES", dict(STRATEGIES))
    ours = strategies.compose("icarl@0.3")
    assert ours.strength == pytest.approx(0.3 * STRATEGIES["icarl"].strength)
    assert replace(ours, source="", strength=1) == replace(
        STRATEGIES["icarl"], source="", strength=1
    )
    assert strategies.STRATEGIES["icarl@0.3"] is ours
    assert strategies.compose("sars+spdd@3").strength == 3
    assert strategies.compose("icarl") is STRATEGIES["icarl"]
    for name in ("icarl@", "icarl@-1", "icarl@x", "@3", "nonsense@3", "sars+nonsense@2"):
        with pytest.raises(InputError, match="unknown; choose from"):
            strategies.compose(name)
