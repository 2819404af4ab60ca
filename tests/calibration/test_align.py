"""A map in a frame of its own comes into the base frame, with an uncertainty that holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.align import align_by_gripper
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_maps import Alignment, SceneMaps, moved_by_frame
from evercal.mapping.store import Store
from evercal.recordings import write_image
from evercal.recordings.frame import Recording
from evercal.simulation.box_room import BoxRoom

Make = Callable[[Path, list[SceneMaps]], Store]
BASE_FROM_MAP = SE3.exp([0.8, -0.3, 0.1, 0.2, -0.1, 1.2])
GRIPPER_FROM_CAMERA = SE3.exp([0.05, 0.02, 0.08, 0.1, 0.2, -0.4])


@pytest.fixture(scope="module")
def arm_views(hall: Recording, hall_room: BoxRoom) -> tuple[list[tuple[str, np.ndarray]], SE3]:
    """Ten images that tilt and turn about the walk of the hall, and map_from_camera of each."""
    rng, poses, images = np.random.default_rng(3), [], []
    camera = hall.train[0].camera
    for i, frame in enumerate(hall.train[2::3]):
        assert frame.base_from_camera is not None
        turned = SE3.exp([0, 0, 0, *rng.normal(0, np.deg2rad(9), 3)])
        poses.append(frame.base_from_camera @ turned)
        images.append((f"{i}.png", hall_room.render(camera, poses[-1])))
    return images, SE3.stack(poses)


def grippers(map_from_camera: SE3, scale: float) -> SE3:
    base_from_camera = SE3.stack([Alignment(BASE_FROM_MAP, scale).pose(p) for p in map_from_camera])
    return base_from_camera @ GRIPPER_FROM_CAMERA.inverse()


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_the_base_is_found_by_a_camera_on_the_gripper(
    scale: float, arm_views: tuple[list, SE3], hall_maps: SceneMaps
) -> None:
    images, map_from_camera = arm_views
    localizer = Localizer(replace(hall_maps, scenes=list(hall_maps.scenes)))
    found = align_by_gripper(
        localizer, "hall", images, grippers(map_from_camera, scale), scale_known=scale == 1.0
    )
    assert found.alignment.scale == pytest.approx(scale, rel=0.01)
    assert found.gripper_from_camera is not None
    # A camera in the middle of the scene: where is it now, and how sure?
    middle = map_from_camera[5]
    placed, truth = found.alignment.pose(middle), Alignment(BASE_FROM_MAP, scale).pose(middle)
    metres, _ = pose_distance(placed, truth)
    spread = np.sqrt(np.trace(moved_by_frame(placed, found.frame_covariance)[:3, :3]))
    assert metres < 0.004 * scale
    assert metres < 4 * spread


def test_a_board_in_the_gripper_takes_the_cameras_place(
    arm_views: tuple[list, SE3], hall_maps: SceneMaps
) -> None:
    images, map_from_camera = arm_views
    rng = np.random.default_rng(0)
    gripper_from_board = SE3.exp([0.0, 0.1, 0.05, 0.3, 0.0, 0.5])
    grippers = SE3.exp(rng.normal(0, np.repeat([0.2, 0.5], 3), (len(images), 6)))
    boards = map_from_camera.inverse() @ BASE_FROM_MAP.inverse() @ grippers @ gripper_from_board
    seen = {name: pose for (name, _), pose in zip(images, boards, strict=True)}
    localizer = Localizer(replace(hall_maps, scenes=list(hall_maps.scenes)))
    found = align_by_gripper(localizer, "hall", images, grippers, True, seen)
    metres, radians = pose_distance(found.alignment.base_from_map, BASE_FROM_MAP)
    assert metres < 0.01
    assert np.rad2deg(radians) < 0.5
    with pytest.raises(InputError, match="board in the gripper is seen in metres"):
        align_by_gripper(localizer, "hall", images, grippers, False, seen)


def test_too_few_images_and_strange_scenes_are_named(
    arm_views: tuple[list, SE3], hall_maps: SceneMaps
) -> None:
    images, map_from_camera = arm_views
    localizer = Localizer(replace(hall_maps, scenes=list(hall_maps.scenes)))
    with pytest.raises(InputError, match="2 of 2 images were located in hall; give at least 5"):
        align_by_gripper(localizer, "hall", images[:2], grippers(map_from_camera[:2], 1.0))
    with pytest.raises(InputError, match="the store does not know it; it has hall"):
        align_by_gripper(localizer, "attic", images, grippers(map_from_camera, 1.0))


def test_the_verb_moves_the_scene_for_good(
    arm_views: tuple[list, SE3], hall_maps: SceneMaps, make: Make, tmp_path: Path
) -> None:
    from evercal.cli import main

    images, map_from_camera = arm_views
    make(tmp_path / "store", [hall_maps])
    poses = grippers(map_from_camera, 1.0)
    (tmp_path / "arm").mkdir()
    rows = ["image,x,y,z,qw,qx,qy,qz"]
    for (name, image), pose in zip(images, poses, strict=True):
        write_image(tmp_path / "arm" / name, image)
        rows.append(",".join(map(str, [name, *pose.translation_m, *pose.rotation_wxyz])))
    (tmp_path / "poses.csv").write_text("\n".join(rows))
    words = [tmp_path / "store", "hall", tmp_path / "arm", "--robot-poses", tmp_path / "poses.csv"]
    assert main(["align", *map(str, words)]) == 0
    answer = Localizer.open(tmp_path / "store").localize(images[4][1])
    assert answer.base_from_camera is not None
    truth = BASE_FROM_MAP @ map_from_camera[4]
    assert pose_distance(answer.base_from_camera, truth)[0] < 0.006
    assert main(["align", str(tmp_path / "store"), "hall"]) == 2
