"""SPDD against calculations in plain Python."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from evercal.continual.methods.spdd import SpddOptions, spdd_loss
from evercal.continual.networks.head import HeadOutput

from ..draws import seeded

INF = math.inf
WEIGHTS = ("prior_weight", "metric_weight", "output_weight")


def head_output(logits: Tensor, offsets: Tensor, points: Tensor) -> HeadOutput:
    return HeadOutput(logits, offsets, points, hidden=points)


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


def random_output(rows, centres, seed, shared=False):
    generator = seeded(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return head_output(
        3 * draw(rows, centres), draw(rows, 1 if shared else centres, 3), draw(rows, 3)
    )


def softmax(values, temperature):
    powers = [math.exp(v / temperature) for v in values]
    return [p / sum(powers) for p in powers]


def spdd_terms(student, teacher, options):
    """The loss, and its terms without their weights."""

    def term(*weights):
        return spdd_loss(
            student,
            teacher,
            replace(options, **dict(zip(WEIGHTS, weights, strict=True))),
        )

    return SimpleNamespace(
        prior=term(1.0, 0.0, 0.0),
        metric=term(0.0, 1.0, 0.0),
        output=term(0.0, 0.0, 1.0),
        total=spdd_loss(student, teacher, options),
    )


def slow_terms(student, teacher, active, temperature):
    """Compute the terms in plain loops, for per-centre offsets; -inf masks a centre."""
    zs = student.logits.tolist()
    zt = teacher.logits.tolist()
    ds = student.offsets.tolist()
    dt = teacher.offsets.tolist()
    rows = len(zt)
    old = len(zt[0])
    prior = metric = output = 0.0
    for n in range(rows):
        alive = [k for k in range(old) if -INF not in (zt[n][k], zs[n][k])]
        best = sorted(alive, key=lambda k: -zt[n][k])[:active]
        p = softmax([zt[n][k] for k in best], temperature)
        q = softmax([zs[n][k] for k in best] + zs[n][old:], temperature)
        prior += temperature**2 * sum(
            a * math.log(a / b) for a, b in zip(p, q, strict=False)
        )
        metric += sum(abs(ds[n][k][i] - dt[n][k][i]) for k in best for i in range(3))
        output += sum(
            abs(a - b)
            for a, b in zip(student.points[n], teacher.points[n], strict=True)
        )
    return prior / rows, metric / rows, float(output) / rows


@pytest.mark.parametrize("new", [0, 1, 5])
@pytest.mark.parametrize(("active", "temperature"), [(1, 1.0), (3, 0.5), (50, 2.0)])
def test_terms_match_a_slow_reference(new, active, temperature):
    teacher = random_output(6, 9, 0)
    student = random_output(6, 9 + new, 1)
    options = SpddOptions(2.0, 3.0, 5.0, temperature, active)
    terms = spdd_terms(student, teacher, options)
    prior, metric, output = slow_terms(student, teacher, active, temperature)
    assert terms.prior.item() == pytest.approx(prior, rel=1e-10)
    assert terms.metric.item() == pytest.approx(metric, rel=1e-10)
    assert terms.output.item() == pytest.approx(output, rel=1e-10)
    total = 2 * prior + 3 * metric + 5 * output
    assert terms.total.item() == pytest.approx(total, rel=1e-10)


def test_probability_of_a_new_centre_is_charged():
    teacher = random_output(5, 8, 3)
    new = tensor([[-4.0], [0.0], [1.0], [3.0], [6.0]])
    student = head_output(
        torch.cat([teacher.logits, new], dim=1),
        torch.cat([teacher.offsets, torch.zeros(5, 1, 3, dtype=torch.float64)], dim=1),
        teacher.points,
    )
    expected = 0.0
    for row, logit in zip(teacher.logits.tolist(), new[:, 0].tolist(), strict=True):
        selected = sum(math.exp(z / 2) for z in sorted(row)[-4:])
        expected += 4 * -math.log(selected / (selected + math.exp(logit / 2))) / 5
    options = SpddOptions(active_centres=4)
    terms = spdd_terms(student, teacher, options)
    assert terms.prior.item() == pytest.approx(expected, rel=1e-10)
    assert expected > 0.1

    student.logits.requires_grad_()
    spdd_terms(student, teacher, options).prior.backward()
    gradient = student.logits.grad
    assert gradient is not None
    assert (
        gradient[:, 8] > 0
    ).all()  # gradient descent lowers the logit of the new centre


def test_shared_offsets():
    student = random_output(2, 4, 0)
    teacher = random_output(2, 4, 1)
    teacher.offsets = tensor([[[0.0, 1.0, 2.0]], [[3.0, 3.0, 3.0]]])
    student.offsets = tensor([[[0.5, 1.0, 0.0]], [[3.0, 2.0, 3.0]]])
    terms = spdd_terms(student, teacher, SpddOptions())
    assert terms.metric.item() == pytest.approx((2.5 + 1.0) / 2)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("new", [0, 2])
def test_gradients(new, shared):
    teacher = random_output(3, 6, 12, shared)
    start = random_output(3, 6 + new, 13, shared)

    def total(logits, offsets, points):
        return spdd_terms(
            head_output(logits, offsets, points), teacher, SpddOptions(1, 2, 3)
        ).total

    leaves = [x.requires_grad_() for x in (start.logits, start.offsets, start.points)]
    assert torch.autograd.gradcheck(total, leaves)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("temperature", [0.1, 2.0])
def test_masked_centres_give_finite_gradients(dtype, temperature):
    """Row 0 masks one active centre in the student, row 1 all but one, row 2 all of them."""
    teacher = random_output(3, 6, 16)
    student = random_output(3, 8, 17)
    student.logits[0, teacher.logits[0].argmax()] = -INF
    teacher.logits[1] = tensor([-INF, -INF, 1.0, -INF, -INF, -INF])
    teacher.logits[2] = -INF
    student.logits[:, 7] = -INF
    for output in (student, teacher):
        output.logits, output.offsets, output.points = (
            x.to(dtype) for x in (output.logits, output.offsets, output.points)
        )
    leaves = [
        x.requires_grad_() for x in (student.logits, student.offsets, student.points)
    ]
    terms = spdd_terms(student, teacher, SpddOptions(temperature=temperature))
    terms.total.backward()
    assert math.isfinite(terms.total.item())
    for leaf in leaves:
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()
    assert student.offsets.grad is not None
    assert student.offsets.grad[1].abs().sum(dim=1).nonzero().flatten().tolist() == [2]
    assert (student.offsets.grad[2] == 0).all()


@pytest.mark.parametrize("who", ["teacher", "student", "both"])
def test_masked_centre_equals_missing_centre(who):
    teacher = random_output(3, 7, 18)
    student = random_output(3, 9, 19)
    teacher.logits[:, 4] = 20.0  # the largest logit
    keep = [k for k in range(9) if k != 4]
    without = spdd_terms(
        head_output(student.logits[:, keep], student.offsets[:, keep], student.points),
        head_output(
            teacher.logits[:, keep[:6]], teacher.offsets[:, keep[:6]], teacher.points
        ),
        SpddOptions(),
    )
    if who != "student":
        teacher.logits[:, 4] = -INF
    if who != "teacher":
        student.logits[:, 4] = -INF
    masked = spdd_terms(student, teacher, SpddOptions())
    assert masked.total.item() == pytest.approx(without.total.item(), rel=1e-12)


@pytest.mark.parametrize("centres", [1, 2, 3, 49, 50, 51, 80])
def test_at_most_fifty_centres_are_active(centres):
    teacher = random_output(3, centres, 22)
    student = random_output(3, centres, 23)
    student.offsets.requires_grad_()
    spdd_terms(student, teacher, SpddOptions()).metric.backward()
    assert student.offsets.grad is not None
    active = (student.offsets.grad.abs().sum(2) > 0).sum(1)
    assert active.tolist() == [min(50, centres)] * 3
