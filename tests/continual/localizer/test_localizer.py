"""From images and cameras to poses; `world` is an oracle, see conftest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from evercal.mapping.scene_maps import SceneMaps

from evercal.errors import InputError
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import pose_distance
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.recordings.frame import Recording
from evercal.simulation.box_room import default_camera

CAMERA = default_camera(160, 120)


def everything(found: PoseEstimate) -> list[bytes | object]:
    """All of an answer but the time it took."""
    arrays = [found.covariance, found.pixels, found.points_m]
    if found.base_from_camera is not None:
        arrays.append(found.base_from_camera.matrix())
    plain = [found.status, found.reason, found.scene, found.inliers, found.inlier_ratio]
    return [*plain, *(None if array is None else array.tobytes() for array in arrays)]


@pytest.mark.parametrize("scene", [0, 1, 2])
def test_true_points_give_the_true_pose_in_the_frame_of_their_scene(scene: int, world: Any) -> None:
    where = world((CAMERA,) * 3)
    image = where.view(scene)
    found = Localizer(where.maps).localize(image, CAMERA)
    where.assert_right(found, image, f"scene-{scene}")
    assert found.inliers == 20 * 15
    assert found.inlier_ratio == 1.0
    assert found.milliseconds > 0
    # Pixels and points are those of the image and the scene's own frame.
    assert found.pixels is not None
    assert found.points_m is not None
    assert found.base_from_camera is not None
    seen = CAMERA.project(found.base_from_camera.inverse().apply(found.points_m))
    np.testing.assert_allclose(seen, found.pixels, atol=0.01)


def test_without_a_camera_that_of_the_scene_is_taken_and_scaled(world: Any) -> None:
    # Two scenes with different lenses: the wrong one would give a wrong pose.
    wide = Camera(640, 480, 400.0, 410.0, 300.0, 250.0)
    where = world((CAMERA, wide))
    localizer = Localizer(where.maps)
    for size in ((640, 480), (320, 240), (160, 120), (80, 60)):
        image = where.view(1, wide, size)
        where.assert_right(localizer.localize(image), image, "scene-1")
        image = where.view(0, CAMERA, size)
        where.assert_right(localizer.localize(image), image, "scene-0")
    image = where.view(1, wide)
    wrong = localizer.localize(image, CAMERA)
    assert wrong.base_from_camera is None or (
        pose_distance(wrong.base_from_camera, where.truth[int(image[0, 0, 0])])[0] > 0.05
    )


def test_a_given_camera_may_have_any_size_and_distortion(world: Any) -> None:
    where = world()
    localizer = Localizer(where.maps)
    bent = Camera(320, 240, 262.0, 262.0, 150.0, 130.0, (-0.2, 0.05, 0.001, -0.002))
    image = where.view(0, bent)
    for camera in (bent, bent.resized(640, 480), bent.resized(160, 120)):
        where.assert_right(localizer.localize(image, camera), image, "scene-0")


def test_portrait_images(world: Any) -> None:
    tall = Camera(120, 160, 130.0, 130.0, 60.0, 80.0)
    where = world((CAMERA, tall))
    localizer = Localizer(where.maps)
    for size in ((120, 160), (240, 320)):
        image = where.view(1, tall, size)
        where.assert_right(localizer.localize(image), image, "scene-1")
        # Only the proportions decide who is asked.
        assert where.oracle.asked[-1] == 1


def test_sizes_that_are_rounded_differently_still_fit(world: Any) -> None:
    # 1272x960 at a short side of 120 is 159 pixels wide, a 160x120 image is 160: one more cell.
    lens = Camera(1272, 960, 1040.0, 1040.0, 640.0, 480.0)
    where = world((lens, lens))
    image = where.view(0, lens, (160, 120))
    for camera in (None, lens):
        where.assert_right(Localizer(where.maps).localize(image, camera), image, "scene-0")


def test_wrong_proportions_are_refused(world: Any) -> None:
    where = world((CAMERA, Camera(100, 100, 90, 90, 50, 50)))
    localizer = Localizer(where.maps)
    image = np.zeros((90, 160, 3), np.uint8)
    with pytest.raises(InputError, match=r"camera 160x120 .* image 160x90"):
        localizer.localize(image, CAMERA)
    with pytest.raises(InputError, match=r"image 160x90.*scene-0 160x120.*scene-1 100x100"):
        localizer.localize(image)
    with pytest.raises(InputError, match="160x90"):
        localizer.localize_batch([where.view(0), image], [None, None])
    with pytest.raises(InputError, match="120x160"):
        localizer.localize(np.zeros((160, 120, 3), np.uint8))


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((120, 160, 4), np.uint8),
        np.zeros((120, 160, 3), np.float32),
        np.zeros((1, 120, 160, 3), np.uint8),
        np.zeros(7, np.uint8),
    ],
)
def test_what_is_no_image_is_refused(world: Any, image: np.ndarray) -> None:
    localizer = Localizer(world((CAMERA,)).maps)
    with pytest.raises(InputError, match=r"image of shape \(.*give \(height, width, 3\) uint8"):
        localizer.localize(image)


def test_grey_images_are_images_too(world: Any) -> None:
    where = world()
    image = where.view(1)
    localizer = Localizer(where.maps)
    assert everything(localizer.localize(image[..., 0])) == everything(localizer.localize(image))


def test_a_batch_says_what_single_images_say(two_threads: None, world: Any) -> None:
    tall = Camera(120, 160, 130.0, 130.0, 60.0, 80.0)
    where = world((CAMERA, tall, CAMERA))
    images = [where.view(i % 3, (CAMERA, tall, CAMERA)[i % 3], right=0.4) for i in range(21)]
    images.append(np.full((120, 160, 3), 255, np.uint8))
    cameras = [None if i % 2 else where.maps.scenes[i % 3].camera for i in range(21)] + [None]
    localizer = Localizer(where.maps)
    alone = [localizer.localize(image, c) for image, c in zip(images, cameras, strict=True)]
    together = localizer.localize_batch(images, cameras)
    assert [everything(a) for a in together] == [everything(a) for a in alone]
    assert [found.scene for found in together[:21]] == [f"scene-{i % 3}" for i in range(21)]
    assert together[21].status != "ok"
    assert localizer.localize_batch([], []) == []


def test_a_batch_of_real_images(
    two_threads: None, arc_maps: tuple[SceneMaps, SceneMaps], arcs: tuple[Recording, Recording]
) -> None:
    localizer = Localizer(arc_maps[1])
    frames = [*arcs[0].test[::4], *arcs[1].test[1::4]]
    images = [frame.read_image() for frame in frames]
    together = localizer.localize_batch(images, [None] * len(images))
    for image, found in zip(images, together, strict=True):
        assert everything(localizer.localize(image)) == everything(found)
    assert torch.get_num_threads() == 2


def test_the_same_image_gives_the_same_bytes(world: Any) -> None:
    where = world()
    image = where.view(1, right=0.3)
    localizer = Localizer(where.maps)
    first = everything(localizer.localize(image))
    np.random.default_rng(0).random(5)
    torch.rand(3)
    localizer.localize(where.view(0))
    assert everything(localizer.localize(image)) == first
    assert everything(Localizer(where.maps).localize(image)) == first


def test_names_and_refusals(tmp_path: Path, world: Any) -> None:
    assert Localizer(world((CAMERA,) * 3).maps).scenes == ("scene-0", "scene-1", "scene-2")
    with pytest.raises(InputError, match=str(tmp_path)):
        Localizer.open(tmp_path)
    with pytest.raises(InputError, match="missing"):
        Localizer.open(str(tmp_path / "missing"))
