"""Distillation: batches, the teacher's principal axes, the loss, and a run that is resumed."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from evercal.features.encoder import load_encoder
from training import distill
from training.distill import Pictures, Teacher, batches, difference, distil
from training.pairs import HEIGHT, WIDTH, leaf_picture

pytestmark = pytest.mark.slow("training", "src/evercal/features")


@pytest.fixture(scope="module")
def data() -> Pictures:
    drawn = [leaf_picture(np.random.default_rng(seed), 300) for seed in range(6)]
    views = np.stack([picture[:HEIGHT, :WIDTH] for picture in drawn])
    return Pictures(views, views[::-1].copy(), np.stack(drawn))


def test_batches_are_the_same_from_any_first_step(data: Pictures) -> None:
    whole = list(batches(data, 0, 3))
    rest = list(batches(data, 2, 3))
    for a, b in zip(whole[2], rest[0], strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert whole[0][0].shape == (8, 1, HEIGHT, WIDTH)
    assert not torch.equal(whole[0][0], whole[0][1])


def test_axes_hold_most_of_the_variance(data: Pictures) -> None:
    teacher = Teacher.of(data, 64)
    image = torch.from_numpy(data.boxes[:1, None] / 255.0).float()
    torch.testing.assert_close(
        teacher.axes.T @ teacher.axes, torch.eye(64), atol=1e-4, rtol=0
    )
    with torch.no_grad():
        rows = teacher.module(image).flatten(2)[0].T
    kept = ((rows @ teacher.axes) ** 2).sum() / (rows**2).sum()
    assert kept > 0.97
    # Similarities of cells stay.
    own = teacher(image).flatten(2)[0].T
    torch.testing.assert_close(own @ own.T, rows @ rows.T, atol=0.06, rtol=0)


def test_the_loss_is_least_for_equal_features() -> None:
    generator = torch.Generator().manual_seed(0)
    target = F.normalize(torch.randn(2, 8, 3, 4, generator=generator), dim=1)
    other = F.normalize(torch.randn(2, 8, 3, 4, generator=generator), dim=1)
    cells = torch.arange(12)
    assert float(difference(target, target, cells)) == pytest.approx(0, abs=1e-5)
    near = F.normalize(target + 0.1 * other, dim=1)
    far = F.normalize(target + 0.5 * other, dim=1)
    assert 0 < difference(near, target, cells) < difference(far, target, cells)


def test_a_run_is_resumed_and_exported(
    data: Pictures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(distill, "CHECKPOINT_STEPS", 2)
    monkeypatch.setattr(distill, "pictures", lambda *_: data)
    distil(data, 2, tmp_path)
    state = torch.load(tmp_path / "student.pt", weights_only=True)
    assert state[0] == 2
    distill.run(tmp_path, steps=2)
    encoder = load_encoder(tmp_path / "encoder.onnx")
    assert (encoder.stride, encoder.width) == (8, 64)
    student = distil(data, 2, tmp_path)
    image = data.boxes[0]
    with torch.no_grad():
        features = student(torch.from_numpy(image[None, None] / 255.0).float())
        expected = features[0].permute(1, 2, 0)
    # Weights are exported in half precision.
    cosine = (encoder(image) * expected.numpy()).sum(-1)
    assert cosine.min() > 0.999
