"""Losses of replayed rows, calculated by hand."""

import math

import pytest
import torch
from torch import Tensor

from evercal.continual.methods.penalties import (
    BoundedByTeacher,
    Distillation,
    OldOutput,
    OldPixels,
    Penalty,
    Relations,
    Reprojection,
)
from evercal.continual.methods.spdd import SpddOptions, spdd_loss
from evercal.continual.networks.head import HeadOutput

from ..draws import seeded
from .by_hand import DEPTH_M, head_output, off_by, rows

PX_PER_M = 50.0


def cost(
    penalty: Penalty,
    student: HeadOutput,
    teacher: HeadOutput | None,
    some: object,
    at: float,
) -> float:
    return float(penalty(student, teacher, some, at).detach())  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("tau", [100.0, 10.0, 1.0])
def test_reprojection_costs_the_loss_of_new_rows(tau: float) -> None:
    actual = cost(
        Reprojection(), head_output([off_by(3.0), off_by(0.0)]), None, rows(2), tau
    )
    assert actual == pytest.approx(tau * math.tanh(3.0 / tau) / 2, rel=1e-5)


def test_old_output_by_hand() -> None:
    # The student is 3 px (6 cm) right of the target, the teacher 2 px (4 cm) left.
    student = head_output([off_by(3.0)])
    teacher = head_output([off_by(-2.0)])
    for px_per_m in (PX_PER_M, 25.0):
        actual = cost(OldOutput(px_per_m), student, teacher, rows(1), 1.0)
        assert actual == pytest.approx(math.tanh(3.0) + px_per_m * 0.10, rel=1e-5)


def test_teacher_bounds_only_a_worse_student() -> None:
    # Row 0: errors 3 px (student) and 1 px (teacher), 4 cm apart. Row 1: the teacher is worse.
    student = head_output([off_by(3.0), off_by(1.0)])
    teacher = head_output([off_by(1.0), off_by(2.0)])
    truth = (math.tanh(3.0) + math.tanh(1.0)) / 2
    expected = 0.5 * truth + 0.5 * PX_PER_M * 0.04 / 2
    assert cost(BoundedByTeacher(), student, teacher, rows(2), 1.0) == pytest.approx(
        expected
    )


def test_relations_by_hand() -> None:
    # For the teacher rows 0 and 1 are equal, for the student rows 1 and 2.
    right = [off_by(0.0)] * 3
    teacher = head_output(right, [[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    student = head_output(right, [[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    near = 1 / (1 + math.exp(-1 / 0.2))
    # Probabilities of row 0: teacher (near, far), student (1/2, 1/2). Row 1: swapped.
    row_0 = near * math.log(2 * near) + (1 - near) * math.log(2 * (1 - near))
    row_1 = near * math.log(near / (1 - near)) + (1 - near) * math.log(
        (1 - near) / near
    )
    row_2 = -0.5 * (math.log(2 * near) + math.log(2 * (1 - near)))
    actual = cost(Relations(), student, teacher, rows(3), 1.0)
    assert actual == pytest.approx((row_0 + row_1 + row_2) / 3, rel=1e-4)
    assert cost(Relations(), teacher, teacher, rows(3), 1.0) == pytest.approx(
        0, abs=1e-6
    )


@pytest.mark.parametrize("scene", [0, 3])
def test_relations_cover_every_remembered_scene(scene: int) -> None:
    """Rows are ordered by scene, 700 of each; a change in any scene has a loss."""
    generator = seeded(1)
    activations = torch.randn(2800, 8, generator=generator)
    right = [off_by(0.0)] * 2800
    teacher = head_output(right, activations.tolist())
    moved = activations.clone()
    moved[700 * scene : 700 * (scene + 1), 0] += 2.0
    actual = cost(
        Relations(), head_output(right, moved.tolist()), teacher, rows(2800), 1.0
    )
    assert actual > 1e-2
    # Each scene has a quarter of the 512 compared rows.
    student = head_output(right, activations.tolist())
    student.hidden.requires_grad_()
    student.hidden.data += 0.1 * torch.randn(2800, 8, generator=generator)
    Relations()(student, teacher, rows(2800), 1.0).backward()
    assert student.hidden.grad is not None
    used = (student.hidden.grad.abs().sum(1) > 0)[700 * scene : 700 * (scene + 1)].sum()
    assert 120 <= int(used) <= 136


def test_old_points_in_pixels_by_hand() -> None:
    """Half reprojection, half the distance to the teacher in pixels at its depth."""
    teacher = head_output([off_by(0.0), off_by(4.0)])
    student = head_output([off_by(3.0), off_by(0.0)])
    for tau_px in (100.0, 7.0, 1.0):
        scale = max(tau_px, 5.0)
        distance = scale * (math.log1p(3.0 / scale) + math.log1p(4.0 / scale)) / 2
        reprojection = tau_px * math.tanh(3.0 / tau_px) / 2
        assert cost(OldPixels(), student, teacher, rows(2), tau_px) == pytest.approx(
            0.5 * distance + 0.5 * reprojection, rel=1e-4
        )


def test_teacher_constrains_the_depth_in_pixels() -> None:
    """A decimetre along the ray is as many pixels as a decimetre across it."""
    teacher = head_output([off_by(0.0)])
    student = head_output([[0.0, 0.0, DEPTH_M + 0.1]])
    focal = float(rows(1).target.focals[0, 0])
    pixels = 0.1 * focal / DEPTH_M
    expected = 0.5 * 5.0 * math.log1p(pixels / 5.0)
    actual = cost(OldPixels(), student, teacher, rows(1), 1.0)
    assert actual == pytest.approx(expected, rel=1e-4)


def output(centres: int, generator: torch.Generator) -> HeadOutput:
    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return HeadOutput(draw(5, centres), draw(5, centres, 3), draw(5, 3), draw(5, 4))


def test_distillation_is_spdd() -> None:
    generator = seeded(0)
    teacher = output(6, generator)
    student = output(8, generator)
    expected = float(spdd_loss(student, teacher, SpddOptions()))
    assert cost(Distillation(), student, teacher, rows(5), 0.7) == pytest.approx(
        expected
    )
    # Without the first two terms it is the L1 distance of the points.
    alone = Distillation(SpddOptions(prior_weight=0.0, metric_weight=0.0))
    drift = float((student.points - teacher.points).abs().sum(-1).mean())
    assert cost(alone, student, teacher, rows(5), 0.7) == pytest.approx(drift, rel=1e-6)
