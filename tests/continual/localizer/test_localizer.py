"""Localization by networks: candidates, poses, thresholds, and cameras that differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evercal.continual.localizer import (
    NetworkLocalizeOptions,
    NetworkLocalizer,
    open_networks,
)
from evercal.errors import InputError
from evercal.geometry import Camera, pose_distance
from evercal.simulation.box_room import default_camera

from .world import CAMERA, make_world

WIDE = Camera(640, 480, 400.0, 410.0, 300.0, 250.0)


@pytest.mark.parametrize("scene", [0, 1, 2])
def test_pose_is_in_the_base_frame_of_its_scene(scene: int) -> None:
    world = make_world((CAMERA,) * 3)
    image = world.view(scene)
    assert NetworkLocalizer(world.scenes).scenes == ("scene-0", "scene-1", "scene-2")
    estimate = world.assert_located(image, scene, CAMERA)
    assert estimate.inliers == 20 * 15
    assert estimate.inlier_ratio == 1.0
    assert estimate.milliseconds > 0
    assert estimate.pixels is not None
    assert estimate.points_m is not None
    assert estimate.base_from_camera is not None
    projected = CAMERA.project(
        estimate.base_from_camera.inverse().apply(estimate.points_m)
    )
    np.testing.assert_allclose(projected, estimate.pixels, atol=0.01)


def test_default_camera_is_that_of_the_scene() -> None:
    world = make_world((CAMERA, WIDE))
    for size in ((640, 480), (320, 240), (160, 120), (80, 60)):
        for scene, camera in enumerate((CAMERA, WIDE)):
            image = world.view(scene, camera, size)
            world.assert_located(image, scene)
    image = world.view(1, WIDE)
    estimate = world.localize(image, CAMERA)
    assert estimate.base_from_camera is None or (
        pose_distance(estimate.base_from_camera, world.pose(image))[0] > 0.05
    )


def test_given_camera_can_have_any_size_and_distortion() -> None:
    world = make_world()
    distorted = Camera(
        320, 240, 262.0, 262.0, 150.0, 130.0, (-0.2, 0.05, 0.001, -0.002)
    )
    image = world.view(0, distorted)
    for camera in (distorted, distorted.resized(640, 480), distorted.resized(160, 120)):
        world.assert_located(image, 0, camera)


def test_only_scenes_of_the_image_aspect_ratio_are_tried() -> None:
    portrait = Camera(120, 160, 130.0, 130.0, 60.0, 80.0)
    world = make_world((CAMERA, portrait))
    image = world.view(1, portrait)
    world.assert_located(image, 1)
    assert world.head.scenes_asked == [1]
    with pytest.raises(
        InputError, match=r"image 160x90.*scene-0 160x120.*scene-1 120x160"
    ):
        world.localize(np.zeros((90, 160, 3), np.uint8))


def test_image_with_few_patches_fails() -> None:
    world = make_world((default_camera(160, 120),))
    world.scenes.short_side = 16  # two rows of two patches
    estimate = world.localize(world.view(0))
    assert (estimate.status, estimate.reason) == ("failed", "fewer than 6 inliers")
    assert (estimate.inliers, estimate.inlier_ratio) == (0, 0.0)


def test_scenes_have_their_own_threshold() -> None:
    world = make_world(threshold=0.5)
    low = world.view(0, correct=0.35)
    high = world.view(0, correct=0.75)
    assert world.localize(high).status == "ok"
    estimate = world.localize(low)
    assert (estimate.status, estimate.base_from_camera) == ("unknown_scene", None)
    assert estimate.inlier_ratio == pytest.approx(0.35, abs=0.03)
    assert "scene-0 needs 50 %" in estimate.reason
    every = NetworkLocalizeOptions(refuses=False)
    answer = world.localize(low, options=every)
    assert answer.status == "ok"
    assert answer.base_from_camera is not None
    assert answer.covariance is None
    records = world.scenes.scenes
    records[0] = replace(records[0], inlier_threshold=0.25)
    assert world.localize(low).status == "ok"


def test_covariance_has_the_scale_of_its_scene() -> None:
    covariances = []
    for scale in (1.0, 7.0):
        world = make_world()
        world.scenes.scenes[0] = replace(world.scenes.scenes[0], covariance_scale=scale)
        estimate = world.localize(world.view(0))
        assert estimate.covariance is not None
        covariances.append(estimate.covariance)
    np.testing.assert_allclose(covariances[1], 7 * covariances[0], rtol=1e-9)


def test_candidates_are_chosen_by_prototypes() -> None:
    world = make_world((CAMERA,) * 4)
    image = world.view(2)

    def candidates(
        descriptor: list[float], options: NetworkLocalizeOptions
    ) -> list[int]:
        world.describe(image, descriptor)
        world.head.scenes_asked.clear()
        world.localize(image, options=options)
        return list(world.head.scenes_asked)

    options = NetworkLocalizeOptions
    # Length 0.927: cosines 0.647, 0.539, 0.431, 0.323.
    descriptor = [
        0.6,
        0.5,
        0.4,
        0.3,
    ]
    assert candidates(descriptor, options(candidates=9, margin=2.0)) == [0, 1, 2, 3]
    assert candidates(descriptor, options(candidates=3, margin=2.0)) == [0, 1, 2]
    assert candidates(descriptor, options(candidates=9, margin=0.12)) == [0, 1]
    assert candidates(descriptor, options(candidates=9, margin=0.23)) == [0, 1, 2]
    assert candidates([0.1, 0.2, 0.9, 0.3], options(candidates=2, margin=2.0)) == [2, 3]
    # The most similar prototype of a scene counts.
    prototypes = torch.tensor([[0.0, 0, 0, 1], [1, 0, 0, 0]]).half()
    world.scenes.scenes[3] = replace(world.scenes.scenes[3], prototypes=prototypes)
    assert sorted(candidates([0.9, 0.1, 0.1, 0], options(margin=0.1))) == [0, 3]


def test_candidate_with_the_most_support_wins() -> None:
    world = make_world((CAMERA,) * 3)
    image = world.view(2)
    world.describe(image, [1.0, 0.9, 0.95, 0])  # most similar to scene 0
    world.assert_located(image, 2)
    assert world.head.scenes_asked == [0, 2, 1]
    one = NetworkLocalizeOptions(candidates=1)
    assert world.localize(image, options=one).inlier_ratio < 0.1


def test_descriptor_conditioned_head_runs_once_for_the_most_similar_scene() -> None:
    world = make_world((CAMERA,) * 3, condition="descriptor")
    for scene in (2, 0, 1):
        image = world.view(scene)
        world.head.scenes_asked.clear()
        world.assert_located(image, scene)
        assert len(world.head.scenes_asked) == 1


def test_right_pose_is_answered_however_long_the_path_of_its_scene() -> None:
    """Scenes of the paper's layout are 5 m apart, and a camera may be farther from the middle."""
    for condition in ("code", "descriptor"):
        world = make_world((CAMERA,) * 3, condition=condition)
        for scene, record in enumerate(world.scenes.scenes):
            x, y, z = record.cell.origin_m
            cell = replace(record.cell, origin_m=(x + 3.5, y - 6.0, z))
            world.scenes.scenes[scene] = replace(record, cell=cell)
        for scene in (1, 0, 2):
            world.assert_located(world.view(scene), scene)


def test_descriptor_conditioned_head_uses_the_camera_of_the_scene() -> None:
    world = make_world((CAMERA, WIDE), condition="descriptor")
    for scene, camera in enumerate((CAMERA, WIDE)):
        image = world.view(scene, camera)
        world.assert_located(image, scene)


def test_folders_without_networks_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(InputError, match=str(path)):
            open_networks(path, "cpu")
