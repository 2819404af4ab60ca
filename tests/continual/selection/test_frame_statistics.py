"""Statistics of frames: features, parts of the scene, gradients."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from evercal.continual.learning.stage import StageOptions
from evercal.continual.networks.buffer import FeatureBuffer, encode_frames
from evercal.continual.networks.head import Head, HeadOptions
from evercal.continual.networks.loss import LossOptions, reprojection_loss
from evercal.continual.selection.frame_statistics import PARTS, FrameStatistics
from evercal.continual.strategies import STRATEGIES
from evercal.geometry import SE3

from ..draws import seeded
from ..stages import EmptyScenes, Rooms, learn


@pytest.fixture(scope="module")
def captured(
    empty_scenes: EmptyScenes, rooms: Rooms, quick: StageOptions
) -> tuple[FrameStatistics, Head, FeatureBuffer]:
    """Frames of `alpha` after some training, with two views of each in the buffer."""
    options = replace(quick, fit=replace(quick.fit, iterations=60))
    scenes = learn(empty_scenes("finetune"), STRATEGIES["finetune"], rooms[0], options)
    buffer = FeatureBuffer(0, scenes.scenes[0].cell.atlas_from_base)
    list(
        encode_frames(
            buffer, rooms[0].train, quick.encode, scenes.encoder, scenes.descriptor
        )
    )
    head = scenes.heads[0].eval()
    return FrameStatistics(rooms[0].train, head, lambda: buffer, 5), head, buffer


def test_features_are_means_over_a_frame(
    captured: tuple[FrameStatistics, Head, FeatureBuffer],
) -> None:
    candidates, head, buffer = captured
    actual = candidates.features()
    assert actual.shape == (len(candidates), head.options.width) == (30, 16)
    for frame in (0, 7, 29):
        where = torch.nonzero(buffer.tensors["view"] == frame)[:, 0]
        rows = buffer.rows(where)
        with torch.no_grad():
            mean = head.hidden(rows.features.float(), 0, rows.descriptor).mean(0)
        np.testing.assert_allclose(actual[frame], mean.numpy(), rtol=1e-5, atol=1e-6)


def test_neighbouring_frames_share_parts(
    captured: tuple[FrameStatistics, Head, FeatureBuffer],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    candidates, _, _ = captured
    monkeypatch.setattr("evercal.continual.selection.frame_statistics.RELIABLE_PX", 1e3)
    monkeypatch.setattr("evercal.continual.selection.frame_statistics.PARTS", 40)
    parts = candidates.visible_parts()
    assert len(parts) == 30
    assert all((np.diff(actual) > 0).all() and actual.min() >= 0 for actual in parts)
    assert max(actual.max() for actual in parts) < 40 < PARTS

    def overlap(a: np.ndarray, b: np.ndarray) -> float:
        return len(np.intersect1d(a, b)) / len(np.union1d(a, b))

    near = np.mean([overlap(parts[i], parts[i + 1]) for i in range(29)])
    far = np.mean([overlap(parts[i], parts[i + 20]) for i in range(10)])
    assert near > far


def test_gradient_predicts_the_change_of_the_loss(
    captured: tuple[FrameStatistics, Head, FeatureBuffer],
) -> None:
    """A small step along the gradient changes the loss by the predicted amount."""
    candidates, head, buffer = captured
    gradient = candidates.gradients()[0]
    own = torch.nonzero(buffer.tensors["view"] == 0)[:, 0]
    drawn = torch.randint(len(own), (256,), generator=seeded(5))
    rows = buffer.rows(own[drawn])

    def loss() -> float:
        with torch.no_grad():
            points = head(rows.features.float(), 0, rows.descriptor).points
            return float(
                reprojection_loss(points, rows.target, 5.0, LossOptions())[0].mean()
            )

    selected = head.logit.data
    part = torch.from_numpy(gradient[: head.logit.numel()]).float().view_as(head.logit)
    step = 2e-2 / float(part.norm())  # much longer than rounding
    losses = []
    for share in (0.5, -0.5):
        head.logit.data = selected + share * step * part
        losses.append(loss())
    head.logit.data = selected
    assert losses[0] - losses[1] == pytest.approx(
        step * float(part.norm()) ** 2, rel=0.1
    )


def test_fixed_centres_all_have_gradients(
    captured: tuple[FrameStatistics, Head, FeatureBuffer], rooms: Rooms
) -> None:
    """Fixed centres belong to no scene, so all of them are used."""
    _, learned_head, buffer = captured
    torch.manual_seed(0)
    options = HeadOptions(
        width=16, blocks=1, condition="descriptor", centres="fixed", centres_per_scene=6
    )
    head = Head(learned_head.features, 8, options)
    head.grow(torch.randn(6, 3) + torch.tensor([0.0, 0.0, 2.0]), seed=0)
    later = FeatureBuffer(1, buffer.atlas_from_base)
    later.extend(dict(buffer.tensors))
    gradients = FrameStatistics(rooms[0].train, head, lambda: later, 5).gradients()
    assert gradients.shape == (
        len(rooms[0].train),
        head.logit.numel() + head.offset.numel(),
    )
    assert np.abs(gradients).max() > 0


def test_draws_depend_on_seed_and_scene(rooms: Rooms) -> None:
    head = Head(4, 4, HeadOptions())
    buffer = FeatureBuffer(0, SE3.identity())

    def drawn(seed: int, scene: int) -> float:
        frames = FrameStatistics(rooms[1].train, head, lambda: buffer, seed, scene)
        assert frames.rng().random() == frames.rng().random()
        return frames.rng().random()

    assert len({drawn(9, 0), drawn(8, 0), drawn(9, 1)}) == 3
