"""Thresholds and covariance scales of networks, fitted to held-out frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from evercal.continual import threshold
from evercal.continual.localizer import NetworkLocalizer
from evercal.continual.scenes import LearnedScenes, SceneRecord
from evercal.continual.threshold import fit_threshold
from evercal.geometry import SE3
from evercal.recordings.frame import Frame, Recording
from evercal.simulation.box_room import BoxRoom, default_camera

from .world import CAMERA, World, make_world

Fit = Callable[[list[Frame], list[np.ndarray]], SceneRecord]


@pytest.fixture
def world() -> World:
    """A scene whose earlier fit must not count."""
    world = make_world((CAMERA,), threshold=0.9)
    world.scenes.scenes[0] = replace(world.scenes.scenes[0], covariance_scale=5.0)
    return world


@pytest.fixture
def fit(world: World, monkeypatch: pytest.MonkeyPatch) -> Fit:
    """Fit the threshold of `world` with given negative images."""

    def fitted(held_out: list[Frame], negatives: list[np.ndarray]) -> SceneRecord:
        monkeypatch.setattr(threshold, "_negative_views", lambda *_: negatives)
        return fit_threshold(world.scenes, held_out)

    return fitted


def frames(world: World, shares: np.ndarray) -> list[Frame]:
    """Views with given shares of correct patches."""
    images = [world.view(0, correct=share) for share in shares]
    return [
        Frame(str(i), image, CAMERA, world.pose(image))
        for i, image in enumerate(images)
    ]


def ratios(world: World, images: list[np.ndarray]) -> list[float]:
    return [world.localize(image).inlier_ratio for image in images]


def test_threshold_lies_a_sixth_above_the_negatives(world: World, fit: Fit) -> None:
    held_out = frames(world, np.linspace(0.9, 0.5, 21))
    negatives = [world.view(0, correct=share) for share in np.linspace(0.1, 0.2, 21)]
    record = fit(held_out, negatives)
    positive = ratios(world, [f.read_image() for f in held_out])
    negative = ratios(world, negatives)
    top = np.quantile(negative, 0.95)
    low = np.quantile(positive, 0.05)
    assert record.inlier_threshold == pytest.approx(top + (low - top) / 6)
    assert max(negative) < record.inlier_threshold < min(positive)
    assert world.scenes.scenes[0].inlier_threshold == 0.9


def test_negatives_are_rejected_even_if_positives_have_fewer_inliers(
    world: World, fit: Fit
) -> None:
    negatives = [world.view(0, correct=0.4) for _ in range(8)]
    record = fit(frames(world, np.full(8, 0.2)), negatives)
    assert record.inlier_threshold == pytest.approx(
        np.quantile(ratios(world, negatives), 0.95)
    )


@pytest.mark.parametrize(("factor", "expected"), [(3.0, 9.0), (0.2, 1.0)])
def test_scaled_covariances_match_the_errors(
    factor: float, expected: float, world: World, fit: Fit
) -> None:
    rng = np.random.default_rng(0)
    held_out = []
    unfitted = replace(
        world.scenes.scenes[0], inlier_threshold=0.0, covariance_scale=1.0
    )
    localizer = NetworkLocalizer(replace(world.scenes, scenes=[unfitted]))
    for i in range(80):
        image = world.view(0, noise_m=0.005)
        pose = localizer.localize(image).uncertain_pose
        assert pose is not None
        error = factor * np.linalg.cholesky(pose.covariance) @ rng.normal(size=6)
        # Translation in the base frame, rotation about the axes of the camera.
        rotated = pose.pose @ SE3.exp(np.array([0, 0, 0, *error[3:]]))
        truth = SE3(rotated.rotation_wxyz, pose.pose.translation_m + error[:3])
        if i % 4 == 0:  # gross errors do not count
            truth = SE3.exp(np.array([2.0, 0, 0, 1, 0, 0])) @ truth
        held_out.append(Frame(str(i), image, CAMERA, truth))
    record = fit(held_out, [world.view(0, correct=0.1)])
    assert record.covariance_scale == pytest.approx(expected, rel=0.25)


def test_views_of_other_rooms_are_rejected(
    arc_scenes: tuple[LearnedScenes, LearnedScenes], arcs: tuple[Recording, Recording]
) -> None:
    scenes = replace(arc_scenes[0], scenes=list(arc_scenes[0].scenes))
    scenes.scenes[0] = fit_threshold(scenes, arcs[0].test[:8])
    localizer = NetworkLocalizer(scenes)
    camera = default_camera(160, 120)
    statuses = [
        localizer.localize(frame.read_image()).status for frame in arcs[0].test[8:]
    ]
    assert statuses.count("ok") >= 0.9 * len(statuses)
    room = BoxRoom(77, texture_px=96)
    views = [
        room.render(camera, room.random_view(np.random.default_rng(i)))
        for i in range(10)
    ]
    views.append(
        np.random.default_rng(0).integers(0, 256, (120, 160, 3)).astype(np.uint8)
    )
    statuses = [localizer.localize(view).status for view in views]
    assert statuses.count("ok") <= 1
