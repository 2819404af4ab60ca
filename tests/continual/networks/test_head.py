"""The scene-coordinate head against closed forms and a slow reference, and its growth."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual.networks.head import (
    Head,
    HeadOptions,
    fresh_head,
    homogeneous_scale,
)
from evercal.errors import InputError

from ..draws import normal

FEATURES = 7
DESCRIPTOR = 5
CENTRES = 3


def grown(options: HeadOptions, scenes: int, features: int = FEATURES) -> Head:
    head = fresh_head(features, DESCRIPTOR, options, seed=5)
    for scene in range(scenes):
        head.grow(4 * normal(CENTRES, 3, seed=scene), seed=scene)
    with torch.no_grad():  # a new scene's biases are zero; a trained head's are not
        head.logit_bias.copy_(normal(*head.logit_bias.shape, seed=8))
        head.offset_bias.copy_(normal(*head.offset_bias.shape, seed=9))
    head.whiten(normal(50, features, seed=7) * torch.linspace(0.1, 3, features) + 1)
    return head.eval()


SHAPES = [
    HeadOptions(width=12, condition="code", offsets="per_centre"),
    HeadOptions(width=12, condition="code", offsets="shared", blocks=2),
    HeadOptions(width=12, condition="descriptor", offsets="per_centre", blocks=0),
    HeadOptions(width=12, condition="descriptor", offsets="shared"),
    HeadOptions(width=FEATURES, condition="code"),  # the first skip is the identity
    HeadOptions(width=12, whiten=False, activation="relu"),
]
CODED = [shape for shape in SHAPES if shape.condition == "code"]


def test_whitening_centres_scales_and_half_decorrelates() -> None:
    mixing = normal(FEATURES, FEATURES, seed=3)
    rows = normal(4000, FEATURES, seed=4) @ mixing + 5
    head = Head(FEATURES, DESCRIPTOR, HeadOptions(width=12))
    head.whiten(rows)
    white = ((rows - head.feature_mean) @ head.feature_map).double()
    torch.testing.assert_close(
        white.mean(0), torch.zeros(FEATURES).double(), atol=1e-5, rtol=0
    )
    assert abs(float(white.std()) - 1) < 1e-3

    def condition(x: Tensor) -> float:
        return float(torch.linalg.cond(torch.cov(x.double().T)))

    # Standard deviations s become s^(1/2): condition numbers of covariances their root.
    assert condition(white) == pytest.approx(math.sqrt(condition(rows)), rel=0.02)
    assert condition(rows) > 50


def test_whitening_does_not_amplify_constant_directions() -> None:
    rows = normal(500, FEATURES, seed=4)
    rows[:, 0] = 2.0
    head = Head(FEATURES, DESCRIPTOR, HeadOptions(width=12))
    head.whiten(rows)
    query = rows[:1].clone()
    query[:, 0] += 1e-3
    white = (torch.cat([rows[:1], query]) - head.feature_mean) @ head.feature_map
    assert float((white[0] - white[1]).abs().max()) < 0.05


def test_scale_in_closed_form() -> None:
    raw = torch.tensor([-torch.inf, -60.0, 0.0, 200.0, torch.inf])
    expected = torch.tensor([0.25, 0.25, 1.0, 100.0, 100.0])
    torch.testing.assert_close(homogeneous_scale(raw), expected)


def by_hand(
    head: Head, feature: np.ndarray, scene: int, descriptor: np.ndarray
) -> np.ndarray:
    """Compute one row's point (3,), layer by layer in double precision."""
    w = {key: value.double().numpy() for key, value in head.state_dict().items()}
    coded = head.options.condition == "code"
    layer = 0

    def linear(name: str, x: np.ndarray) -> np.ndarray:
        nonlocal layer
        y = w[f"{name}.weight"] @ x + w[f"{name}.bias"]
        if coded:
            y = y + w["code"][scene, layer]
        layer += 1
        if head.options.activation == "relu":
            return np.maximum(y, 0)
        return np.array([v * (1 + math.erf(v / math.sqrt(2))) / 2 for v in y])

    if head.options.whiten:
        feature = (feature - w["feature_mean"]) @ w["feature_map"]
    else:
        feature = math.sqrt(len(feature)) * feature  # unit length to unit variance
    x = feature if coded else np.concatenate([descriptor, feature])
    y = x
    for i in range(3):
        y = linear(f"first.{i}", y)
    y = y + (w["skip.weight"] @ x + w["skip.bias"] if "skip.weight" in w else x)
    for block in range(head.options.blocks):
        z = y
        for i in range(3):
            z = linear(f"blocks.{block}.{i}", z)
        y = y + z
    for i in range(2):
        y = linear(f"last.{i}", y)
    assert layer == head.layers

    total = np.zeros(3)
    weight = 0.0
    beta = math.log(2) / 0.75
    for k, centre in enumerate(w["centres"]):
        if coded and w["centre_scene"][k] != scene:
            continue
        share = math.exp(w["logit"][k] @ y + w["logit_bias"][k])
        own = k if head.options.offsets == "per_centre" else 0
        *offset, raw = w["offset"][own] @ y + w["offset_bias"][own]
        scale = min(math.log(1 + math.exp(beta * raw)) / beta + 0.25, 100.0)
        total += share * (centre + np.array(offset) / scale)
        weight += share
    return total / weight


@pytest.mark.parametrize("options", SHAPES)
def test_points_match_a_slow_reference(options: HeadOptions) -> None:
    head = grown(options, 3)
    features = normal(9, FEATURES, seed=1)
    descriptors = normal(9, DESCRIPTOR, seed=2)
    scene = torch.arange(9) % 3
    with torch.no_grad():
        points = head(features, scene, descriptors).points.numpy()
    for i in range(9):
        twin = by_hand(
            head, features[i].double().numpy(), i % 3, descriptors[i].double().numpy()
        )
        np.testing.assert_allclose(points[i], twin, atol=1e-5)


@pytest.mark.parametrize("options", CODED)
@pytest.mark.parametrize("rows", [1, 40, 1200])
def test_new_scenes_do_not_change_the_output_for_old_scenes(
    options: HeadOptions, rows: int
) -> None:
    head = grown(options, 2)
    features = normal(rows, FEATURES, seed=1)
    mixed = torch.arange(rows) % 2
    with torch.no_grad():
        before = [head(features, scene, None).points for scene in (0, 1)]
        together = head(features, mixed, None).points
        for more in range(3):
            head.grow(20 * normal(CENTRES + more, 3, seed=more), seed=more)
            for scene in (0, 1):
                assert torch.equal(head(features, scene, None).points, before[scene])
            # With rows of several scenes, rounding depends on the number of centres.
            close = head(features, mixed, None).points
            torch.testing.assert_close(close, together, atol=1e-5, rtol=0)
    assert head.scenes == 5
    assert all(parameter.requires_grad for parameter in head.parameters())
    assert not torch.equal(before[0], before[1])


@pytest.mark.parametrize("level", [0.0, -20.0])
def test_new_centres_of_a_shared_softmax_hardly_move_old_points(level: float) -> None:
    head = grown(SHAPES[3], 1)
    head.logit_bias.data += level  # a softmax depends on differences only
    features = normal(200, FEATURES, seed=1)
    descriptors = normal(200, DESCRIPTOR, seed=2)
    with torch.no_grad():
        before = head(features, 0, descriptors).points
        head.grow(20 * normal(100, 3, seed=3), seed=3)
        after = head(features, 0, descriptors).points
    assert (after - before).norm(dim=-1).max() < 0.02
    assert len(head.centres) == CENTRES + 100


@pytest.mark.parametrize("options", CODED)
def test_scene_index_and_scene_tensor_agree(options: HeadOptions) -> None:
    head = grown(options, 3)
    features = normal(50, FEATURES, seed=1)
    for scene in range(3):
        own = head.centre_scene == scene
        with torch.no_grad():
            one = head(features, scene, None)
            many = head(features, torch.full((50,), scene), None)
        torch.testing.assert_close(one.points, many.points, atol=1e-5, rtol=0)
        torch.testing.assert_close(one.logits, many.logits[:, own], atol=1e-5, rtol=0)
        assert torch.isneginf(many.logits[:, ~own]).all()
        assert (many.logits.softmax(-1)[:, ~own] == 0).all()


def test_with_a_descriptor_the_scene_index_is_ignored() -> None:
    head = grown(SHAPES[3], 3)
    features = normal(30, FEATURES, seed=1)
    first = normal(30, DESCRIPTOR, seed=2)
    second = normal(30, DESCRIPTOR, seed=3)
    with torch.no_grad():
        points = head(features, 0, first).points
        assert torch.equal(head(features, 2, first).points, points)
        assert torch.equal(head(features, torch.arange(30) % 3, first).points, points)
        assert not torch.allclose(head(features, 0, second).points, points)
        assert torch.isfinite(head(features, 0, first).logits).all()


def test_centres_are_added_in_fp32_under_autocast() -> None:
    """At 5 km the resolution of bfloat16 is 32 m, so only the offset may be in bfloat16."""
    head = grown(SHAPES[0], 1)
    features = normal(30, FEATURES, seed=1)
    head.centres += torch.tensor([5000.0, 0.0, 0.0])
    with torch.no_grad():
        exact = head(features, 0, None).points
        with torch.autocast("cpu", torch.bfloat16):
            mixed = head(features, 0, None)
    assert (
        mixed.points.dtype == mixed.logits.dtype == mixed.offsets.dtype == torch.float32
    )
    torch.testing.assert_close(mixed.points, exact, atol=0.2, rtol=0)


def test_fixed_centres_need_the_descriptor() -> None:
    options = HeadOptions(width=8, condition="descriptor", centres="fixed")
    head = Head(FEATURES, DESCRIPTOR, options)
    head.grow(normal(6, 3), 0)
    head.grow(torch.zeros(0, 3), 1)
    assert head.centres.shape == (6, 3)
    points = head(normal(4, FEATURES), 1, normal(4, DESCRIPTOR)).points
    assert torch.isfinite(points).all()
    with pytest.raises(InputError, match="condition 'code'"):
        Head(FEATURES, DESCRIPTOR, replace(options, condition="code"))


def test_fresh_head_depends_on_its_seed_only() -> None:
    before = torch.random.get_rng_state()
    first, again, other = (
        fresh_head(FEATURES, DESCRIPTOR, SHAPES[1], seed=s) for s in (1, 1, 2)
    )
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(first.offset, again.offset)
    assert not torch.equal(first.offset, other.offset)
    Head.from_state(FEATURES, DESCRIPTOR, SHAPES[1], first.state_dict())
    assert torch.equal(torch.random.get_rng_state(), before)
