"""Furnished rooms for pretraining: correspondences, cached files, reserved seeds.

Rendering needs Mitsuba.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from rooms.room import RESERVED
from rooms.suites import SUITES
from training import contrastive, furnished
from training.contrastive import (
    PairStream,
    PretrainData,
    PretrainOptions,
    make_data,
)
from training.furnished import (
    FurnishedViews,
    cached_furnished_views,
    furnished_views,
)
from training.pairs import (
    END_ROOM_SEED,
    FIRST_ROOM_SEED,
    HEIGHT,
    PER_ANCHOR,
    VALIDATION_ROOM_SEED,
    WIDTH,
    view_pair,
)

pytestmark = pytest.mark.slow("training", "src/evercal/features")

CAMERA = Camera(WIDTH, HEIGHT, 200.0, 200.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def step() -> FurnishedViews:
    """Two views of a wall at 2 m whose left half is at 1 m."""
    depth = np.full((2, HEIGHT, WIDTH), 2.0, np.float16)
    depth[0, :, : WIDTH // 2] = 1.0
    shift = 0.1
    edge = WIDTH // 2 - round(shift * 200)  # parallax of 20 pixels
    depth[1, :, :edge] = 1.0
    depth[:, :20] = 0.0  # no surface
    move = SE3(np.array([1.0, 0, 0, 0]), np.array([shift, 0, 0]))
    images = np.zeros((2, HEIGHT, WIDTH), np.uint8)
    return FurnishedViews(
        images, SE3.stack([SE3.identity(), move]), (CAMERA, CAMERA), depth
    )


def test_depth_maps_give_points_and_occlusion() -> None:
    views = step()
    pixels = np.array([[40.0, 100.0], [200.0, 100.0], [40.0, 5.0]])
    points = views.hit(0, pixels)
    np.testing.assert_allclose(points[:2, 2], [1.0, 2.0])
    np.testing.assert_allclose(CAMERA.project(points[:2]), pixels[:2])
    assert np.isnan(points[2]).all()
    first, second = view_pair(views, 0, 1, np.random.default_rng(0)).pixels
    near = first[:, 0] < WIDTH // 2 - 0.5
    parallax = (first - second)[:, 0]
    np.testing.assert_allclose(parallax[near], 20.0, atol=1e-3)
    np.testing.assert_allclose(parallax[~near], 10.0, atol=1e-3)
    assert min(near.sum(), (~near).sum()) > 100
    assert first[:, 1].min() > 19
    # The near half occludes a strip of the far half.
    back = view_pair(views, 1, 0, np.random.default_rng(0)).pixels[0]
    strip = WIDTH // 2 - 20
    assert not ((back[:, 0] > strip) & (back[:, 0] < strip + 9)).any()


def test_pretraining_uses_reserved_seeds(tmp_path: Path) -> None:
    shown = [seed for suite in SUITES.values() for *_, seed in suite.rooms]
    assert not [seed for seed in shown if FIRST_ROOM_SEED <= seed < END_ROOM_SEED]
    assert max(shown) < VALIDATION_ROOM_SEED
    assert VALIDATION_ROOM_SEED + 100 < RESERVED
    for options, message in (
        (PretrainOptions(furnished=3_001), "at most 3000"),
        (PretrainOptions(rooms=3_001), "at most 3000"),
        (PretrainOptions(furnished=0), "at least 1"),
    ):
        with pytest.raises(InputError, match=message):
            make_data(options, tmp_path)


def test_batch_contains_furnished_rooms() -> None:
    two = step()
    images = np.stack(
        [np.full((HEIGHT, WIDTH), grey, np.uint8) for grey in (80, 81, 82, 83)]
    )
    four = FurnishedViews(
        images,
        SE3.stack([*two.base_from_camera, *two.base_from_camera]),
        two.cameras * 2,
        np.concatenate([two.depth_m, two.depth_m]),
    )
    picture = np.full((300, 300), 200, np.uint8)
    options = PretrainOptions(room_pairs=0, furnished_pairs=2, leaf_pairs=1, points=64)
    patch = pytest.MonkeyPatch()
    with patch.context() as patched:
        patched.setattr(contrastive, "photometric", lambda image, rng: image)
        data = PretrainData([], [picture], [four])
        grey, pixels, valid = PairStream(data, options, 0).draw(0)
    assert grey.shape == (2, 3, 1, HEIGHT, WIDTH)
    shades = (grey[:, :, 0, 96, 128] * 255).round().int()
    assert ((shades[:, :2] >= 80) & (shades[:, :2] <= 83)).all()
    assert (shades[:, 2] == 200).all()
    # The parallax of these cameras is 0, 10 or 20 pixels.
    across = (pixels[0, :2] - pixels[1, :2])[valid[:2]][:, 0].abs()
    assert (across[:, None] - torch.tensor([0.0, 10.0, 20.0])).abs().min(
        1
    ).values.max() < 1e-2


def test_rendered_pairs_correspond_and_are_cached(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    views = furnished_views(1001, anchors=1)
    assert views.images.shape == views.depth_m.shape == (PER_ANCHOR, HEIGHT, WIDTH)
    rng = np.random.default_rng(0)
    captured = []
    for first, second in ((0, 1), (2, 3), (1, 2)):
        pair = view_pair(views, first, second, rng)
        assert pair.pixels.shape[1] > 20
        (u, v), (x, y) = np.rint(pair.pixels).astype(int).transpose(0, 2, 1)
        captured.append(
            np.stack([pair.images[0, v, u], pair.images[1, y, x]]).astype(float)
        )
        # Both views give the same surface point.
        gap = views.hit(first, pair.pixels[0]) - views.hit(second, pair.pixels[1])
        assert np.median(np.linalg.norm(gap, axis=-1)) < 0.01
    left, right = np.concatenate(captured, 1)
    assert np.corrcoef(left, right)[0, 1] > 0.8
    patch = pytest.MonkeyPatch()
    with patch.context() as patched:
        patched.setattr(furnished, "furnished_views", lambda seed: views)
        selected = cached_furnished_views(1001, tmp_path / "new")
        patched.setattr(furnished, "furnished_views", None)
        again = cached_furnished_views(1001, tmp_path / "new")
    for actual in (selected, again):
        np.testing.assert_array_equal(actual.images, views.images)
        np.testing.assert_array_equal(actual.depth_m, views.depth_m)
        np.testing.assert_allclose(
            actual.base_from_camera.matrix(),
            views.base_from_camera.matrix(),
            atol=1e-12,
        )
        assert actual.cameras == views.cameras
