"""Contrastive training: closed forms, an oracle, resuming."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.data import DataLoader

from evercal.errors import InputError
from training import contrastive
from training.contrastive import (
    Batch,
    PairStream,
    PretrainData,
    PretrainOptions,
    contrastive_loss,
    matching_accuracy,
    sample_features,
    train_encoder,
)
from training.network import Layout
from training.pairs import HEIGHT, WIDTH, RoomViews, cell_pixels, leaf_picture

from ..encoders import TINY

pytestmark = pytest.mark.slow("training", "src/evercal/features")

OPTIONS = PretrainOptions(
    steps=6, room_pairs=2, furnished_pairs=0, leaf_pairs=1, points=64
)
SMALL = Layout(*TINY)
FAR = torch.tensor([[0.0, 0.0], [100.0, 0.0]])


@pytest.fixture(scope="module")
def data(views: RoomViews) -> PretrainData:
    return PretrainData([views], [leaf_picture(np.random.default_rng(0))])


def unit(*shape: int, seed: int = 0) -> Tensor:
    return F.normalize(
        torch.randn(*shape, generator=torch.Generator().manual_seed(seed)), dim=-1
    )


def twice(pixels: Tensor) -> Tensor:
    """Use the same pixels in both images."""
    return torch.stack([pixels, pixels])


def test_features_at_cell_centres_are_exact() -> None:
    maps = unit(2, HEIGHT // 8, WIDTH // 8, 5).permute(0, 3, 1, 2)
    pixels = torch.from_numpy(cell_pixels()).float().expand(2, -1, -1)
    actual = sample_features(maps, pixels)
    torch.testing.assert_close(
        actual, maps.flatten(2).transpose(1, 2), atol=1e-5, rtol=0
    )


def test_features_between_cells_are_bilinear_unit_vectors() -> None:
    maps = unit(1, HEIGHT // 8, WIDTH // 8, 5).permute(0, 3, 1, 2)
    pixel = torch.tensor([[[8 * 4.25 + 3.5, 8 * 6.5 + 3.5]]])
    grid = maps[0]
    mixed = 0.5 * (
        0.75 * (grid[:, 6, 4] + grid[:, 7, 4]) + 0.25 * (grid[:, 6, 5] + grid[:, 7, 5])
    )
    actual = sample_features(maps, pixel)[0, 0]
    torch.testing.assert_close(actual, F.normalize(mixed, dim=0), atol=1e-5, rtol=0)


@pytest.mark.parametrize("dense", [False, True])
def test_loss_matches_a_slow_reference(dense: bool) -> None:
    generator = torch.Generator().manual_seed(3)
    features = unit(2, 3, 5, 4, seed=1)
    pixels = torch.rand(2, 3, 5, 2, generator=generator) * 25
    valid = torch.rand(3, 5, generator=generator) < 0.7
    grid = cell_pixels()
    cells = unit(2, 3, len(grid), 4, seed=2)
    points = [(i, k) for i in range(3) for k in range(5) if valid[i, k]]
    total = 0.0
    for one, other in ((0, 1), (1, 0)):
        for i, k in points:
            here = features[one, i, k]
            truth = pixels[other, i, k].tolist()
            rivals = [
                (j, features[other, j, m], pixels[other, j, m].tolist())
                for j, m in points
                if (j, m) != (i, k)
            ]
            if dense:
                rivals += [(i, cells[other, i, m], grid[m]) for m in range(len(grid))]
            right = math.exp(float(here @ features[other, i, k]) / 0.2)
            wrong = sum(
                math.exp(float(here @ rival) / 0.2)
                for j, rival, where in rivals
                if j != i or math.dist(truth, where) >= 10
            )
            total -= math.log(right / (right + wrong))
    actual = contrastive_loss(features, pixels, valid, 0.2, cells if dense else None)
    assert float(actual) == pytest.approx(total / len(points) / 2, rel=1e-4)


class Oracle(nn.Module):
    """Gives every cell of the first images a unique vector; the second images are shifted."""

    def __init__(self, columns: int):
        super().__init__()
        self.columns = columns

    def forward(self, grey: Tensor) -> Tensor:
        maps = unit(HEIGHT // 8, WIDTH // 8, 64).permute(2, 0, 1)
        half = len(grey) // 2
        return torch.stack([maps] * half + [maps.roll(self.columns, -1)] * half)


@pytest.mark.parametrize("columns", [0, 2, -3])
def test_matching_accuracy_of_an_oracle(
    columns: int,
) -> None:
    rng = np.random.default_rng(0)
    inner = cell_pixels().reshape(HEIGHT // 8, WIDTH // 8, 2)[2:-2, 4:-4].reshape(-1, 2)
    pixels = torch.from_numpy(rng.permutation(inner)[:100]).float().expand(3, -1, -1)
    there = pixels + torch.tensor([8.0 * columns, 0.0])
    images = torch.zeros(2, 3, 1, HEIGHT, WIDTH)
    valid = torch.ones(3, 100, dtype=torch.bool)
    oracle = Oracle(columns)

    def evaluate(truth: Tensor, valid: Tensor = valid) -> float:
        batch = Batch(images, torch.stack([pixels, truth]), valid)
        return matching_accuracy(oracle, [batch])

    for down, accuracy in ((0.0, 100.0), (7.5, 100.0), (8.5, 0.0), (-40.0, 0.0)):
        assert evaluate(there + torch.tensor([0.0, down])) == accuracy
    half = torch.arange(100).expand(3, -1) < 50
    mixed = torch.where(half[..., None], there, there + 40)
    assert evaluate(mixed) == 50.0
    assert evaluate(mixed, half) == 100.0


def test_batches_depend_on_seed_and_step_only(data: PretrainData) -> None:
    stream = PairStream(data, OPTIONS, 0)
    images, pixels, valid = stream.draw(4)
    assert images.shape == (2, 3, 1, HEIGHT, WIDTH)
    assert pixels.shape == (2, 3, 64, 2)
    assert valid.shape == (3, 64)
    assert float(images.min()) >= 0
    assert float(images.max()) <= 1
    assert (valid.sum(1) >= 48).all()
    assert (pixels[:, valid] >= 3.5 - 1e-4).all()
    assert (pixels[..., ~valid, :] == 0).all()
    for other in (stream.draw(4), next(iter(PairStream(data, OPTIONS, 4)))):
        assert all(map(torch.equal, other, (images, pixels, valid)))
    assert not torch.equal(stream.draw(5)[0], images)
    assert not torch.equal(
        PairStream(data, replace(OPTIONS, seed=2), 0).draw(4)[0], images
    )
    assert len(list(PairStream(data, OPTIONS, 4))) == 2


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, one_room: RoomViews) -> None:
    """Use a small encoder, checkpoints every two steps, and no worker process."""
    monkeypatch.setattr(contrastive, "CHECKPOINT_STEPS", 2)
    monkeypatch.setattr(contrastive, "TEACHER", SMALL)
    monkeypatch.setattr(contrastive, "DataLoader", lambda stream, **_: stream)
    draw = PairStream.draw
    batches: dict[int, Batch] = {}

    def cheap(stream: PairStream, step: int) -> Batch:
        if stream.options.room_pairs != 8:
            return draw(stream, step)
        stream.options = replace(stream.options, room_pairs=1)  # the validation set
        batches[step] = batches.get(step) or draw(stream, 0)
        stream.options = replace(stream.options, room_pairs=8)
        return batches[step]

    monkeypatch.setattr(PairStream, "draw", cheap)


class StopError(Exception):
    pass


def trained(
    data: PretrainData, options: PretrainOptions, folder: Path
) -> tuple[dict[str, Tensor], list[str]]:
    """Train the encoder; its weights and the lines of the log."""
    folder.mkdir(exist_ok=True)
    lines: list[str] = []
    encoder = train_encoder(data, options, folder, lines.append)
    return encoder.state_dict(), lines


@pytest.mark.usefixtures("small")
def test_resumed_training_equals_uninterrupted_training(
    data: PretrainData, tmp_path: Path
) -> None:
    (tmp_path / "b").mkdir()
    whole, _ = trained(data, OPTIONS, tmp_path / "a")

    def stop(line: str) -> None:
        if line.startswith("step 4"):
            raise StopError

    with pytest.raises(StopError):
        train_encoder(data, OPTIONS, tmp_path / "b", stop)
    again, lines = trained(data, OPTIONS, tmp_path / "b")
    assert lines[0] == "resumed at step 2"
    assert [line.split()[1] for line in lines[1:]] == ["4", "6"]
    # A finished run does no further steps.
    third, lines = trained(data, OPTIONS, tmp_path / "b")
    assert lines == ["resumed at step 6"]
    for name, value in whole.items():
        assert torch.equal(value, again[name]), name
        assert torch.equal(value, third[name]), name
    # A checkpoint with other options is ignored.
    _, lines = trained(data, replace(OPTIONS, seed=7, steps=2), tmp_path / "b")
    assert not any("resumed" in line for line in lines)


@pytest.mark.usefixtures("small")
def test_training_lowers_the_loss(data: PretrainData, tmp_path: Path) -> None:
    _, lines = trained(data, replace(OPTIONS, steps=24, peak_rate=1e-2), tmp_path)
    losses = [float(line.split()[3]) for line in lines]
    assert np.mean(losses[-3:]) < 0.93 * np.mean(losses[:2])
    assert losses[0] < math.log(3 * 64 + len(cell_pixels())) + 1


@pytest.mark.usefixtures("small")
def test_training_starts_from_an_earlier_run(
    data: PretrainData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contrastive, "DataLoader", DataLoader)  # with a worker process
    first = tmp_path / "first"
    before, _ = trained(data, replace(OPTIONS, steps=2), first)
    start = replace(OPTIONS, steps=1, peak_rate=1e-9, init=str(first / "encoder.pt"))
    after = train_encoder(data, start, tmp_path, print)
    for name, value in after.named_parameters():
        torch.testing.assert_close(value, before[name], atol=1e-6, rtol=0)
    (tmp_path / "nonsense.pt").write_bytes(b"nonsense")
    for bad in ("nonsense.pt", "none.pt"):
        with pytest.raises(InputError, match=r"not the encoder\.pt of a run"):
            trained(data, replace(start, init=str(tmp_path / bad)), tmp_path)
