"""The virtual cell: kinematics, time, noise, and that its truth explains what it states."""

import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance, pose_distance_mm_deg, pose_to_dict
from evercal.live.coverage import sharpness
from evercal.recordings import load_recording, read_robot_poses
from evercal.recordings.frame import stated_grippers
from evercal.simulation.cell_recording import record_cell
from evercal.simulation.cell_room import TABLE_M, cell_room
from evercal.simulation.panda_arm import (
    HIGH_RAD,
    HOME_RAD,
    LOW_RAD,
    base_from_flange,
    joints_for,
)
from evercal.simulation.virtual_cell import CellOptions, VirtualCell, nominal_mount
from evercal.simulation.virtual_robot import Clock, VirtualRobot

SMALL = CellOptions(width=160, height=120)


def test_the_arm_is_at_its_documented_place_when_stretched() -> None:
    """All joints at zero: up 0.333 + 0.316 + 0.384 - 0.107 m, out 0.088 m."""
    np.testing.assert_allclose(
        base_from_flange(np.zeros(7)).translation_m, (0.088, 0, 0.926), atol=1e-12
    )


def test_inverse_kinematics_undo_forward_kinematics_within_limits() -> None:
    rng = np.random.default_rng(1)
    for joints in np.clip(
        HOME_RAD + rng.uniform(-0.8, 0.8, (20, 7)), LOW_RAD, HIGH_RAD
    ):
        pose = base_from_flange(joints)
        found = joints_for(pose, HOME_RAD)
        assert max(pose_distance(base_from_flange(found), pose)) < 3e-6
        assert ((found >= LOW_RAD) & (found <= HIGH_RAD)).all()
    with pytest.raises(InputError, match="does not reach"):
        joints_for(SE3.from_translation((2.0, 0, 0.5)), HOME_RAD)


def test_motions_take_time_and_other_threads_see_them() -> None:
    robot = VirtualRobot(Clock(real=True), 0.0, 0.0, 0)
    target = base_from_flange(HOME_RAD + np.array([1.2, 0, 0, 0, 0, 0, 0]))
    start = robot.base_from_gripper()
    began = time.monotonic()
    thread = threading.Thread(target=robot.move_to, args=(target,))
    thread.start()
    time.sleep(0.15)
    between = robot.base_from_gripper()
    thread.join()
    assert time.monotonic() - began > 0.3
    assert pose_distance(start, between)[1] > 0.01
    assert pose_distance(between, target)[1] > 0.01
    assert max(pose_distance(robot.base_from_gripper(), target)) < 1e-5


def test_the_true_pose_differs_by_the_stated_noise_and_stays_while_the_arm_stands() -> (
    None
):
    clock = Clock(real=False)
    robot = VirtualRobot(clock, 1e-3, 2e-3, 5)
    rng = np.random.default_rng(3)
    errors = []
    for joints in HOME_RAD + rng.uniform(-0.3, 0.3, (80, 7)):
        robot.move_to(base_from_flange(joints))
        truth = robot.true_state(clock.now())[0]
        errors.append((robot.base_from_gripper().inverse() @ truth).log())
        assert max(pose_distance(truth, robot.true_state(clock.now() + 9)[0])) < 1e-12
    sigma = np.std(errors, axis=0)
    np.testing.assert_allclose(sigma, np.repeat([1e-3, 2e-3], 3), rtol=0.3)


def test_images_follow_the_true_mount() -> None:
    """Rendered from the stated pose and the true mount, an image differs by noise only."""
    exact = CellOptions(
        width=160, height=120, arm_noise_mm=0, arm_noise_deg=0, show_arm=False
    )
    cell = VirtualCell(4, exact)
    pose = cell.reachable_poses(1)[0]
    cell.robot.move_to(pose)
    image = cell.wrist_camera.read()[1].astype(float)
    at_truth = pose @ cell.truth.gripper_from_camera
    difference = image - cell_room(4).render(cell.intrinsics, at_truth)
    assert np.median(np.abs(difference)) < 3
    elsewhere = cell_room(4).render(cell.intrinsics, pose @ nominal_mount())
    assert np.abs(image - elsewhere).mean() > 4 * np.abs(difference).mean()


def test_the_table_is_below_the_arm() -> None:
    eye = np.array([0.5, 0.62, 0.3])
    _, depth = cell_room(4).intersect(eye, np.array([[0.0, 0.0, -1.0]]))
    assert depth[0] == pytest.approx(0.3, abs=1e-9)
    outside = np.array([0.5, 0.8, 0.3])
    _, depth = cell_room(4).intersect(outside, np.array([[0.0, 0.0, -1.0]]))
    assert depth[0] <= TABLE_M + 0.3 + 1e-9


def test_a_moving_camera_blurs() -> None:
    cell = VirtualCell(4, CellOptions(320, 240, exposure_s=0.02))
    cell.robot.move_to(cell.reachable_poses(1)[0])
    still = cell.wrist_camera.read()[1]
    cell.clock.sleep(-cell.clock.now() / 2)  # back to the middle of the motion
    moving = cell.wrist_camera.read()[1]
    assert sharpness(moving) < 0.9 * sharpness(still)


def test_a_recording_is_read_back_and_states_its_truth_apart(tmp_path: Path) -> None:
    out = tmp_path / "cell"
    assert len(list(record_cell(out, 6, 4, SMALL))) == 4 + 8 + 25
    frames = load_recording(out / "wrist").train
    assert len(frames) == 4
    assert len(load_recording(out / "held").train) == 25
    assert len(list((out / "tripod").glob("*.jpg"))) == 8
    assert len(read_robot_poses(out / "reachable.csv").poses) == 200
    truth = json.loads((out / "truth.json").read_text())
    cell = VirtualCell(6, SMALL)
    assert truth["gripper_from_camera"] == pose_to_dict(cell.truth.gripper_from_camera)
    mount = cell.truth.gripper_from_camera
    millimetres, degrees = pose_distance_mm_deg(mount, nominal_mount())
    assert 1 < millimetres < 40
    assert 0.5 < degrees < 12
    assert not any(path.name == "truth.json" for path in (out / "wrist").rglob("*"))
    with pytest.raises(InputError, match="not empty"):
        next(record_cell(out))


def test_reserved_seeds_are_refused() -> None:
    with pytest.raises(InputError, match="reserved"):
        VirtualCell(9000)


@pytest.mark.slow("src/evercal/simulation")
def test_the_whole_chain_finds_the_truth(tmp_path: Path) -> None:
    """Mount, fixed camera by the scene, fixed camera by a held thing: to 1 mm and 0.05 deg."""
    from evercal import Map

    list(record_cell(tmp_path / "cell", 3))
    truth = VirtualCell(3).truth
    learned = Map.open(tmp_path / "map")
    report = learned.learn(tmp_path / "cell/wrist").hand_eye
    assert report is not None
    fixed = learned.calibrate(tmp_path / "cell/tripod").parent_from_child
    thing = Map.open(tmp_path / "thing")
    recorded = load_recording(tmp_path / "cell/held")
    reference = thing.eye_to_hand(recorded)
    held = reference.parent_from_child
    assert all(Path(image.name).is_file() for image in reference.images)
    for found, true in (
        (report.parent_from_camera.pose, truth.gripper_from_camera),
        (fixed, truth.base_from_tripod),
        (held, truth.base_from_tripod),
    ):
        millimetres, degrees = pose_distance_mm_deg(found, true)
        assert millimetres < 1
        assert degrees < 0.05

    # The thing is taken again another way, with the camera in its place or not.
    images = [frame.read_image() for frame in recorded.train[::2]]
    grippers = stated_grippers(recorded.train[::2])
    grip = SE3.exp([0.02, -0.01, 0.03, 0.1, 0.2, 0])
    moved = SE3.exp([0.01, 0, 0, 0, 0.02, 0])
    for by_camera, by_grip in (
        ("", ""),
        ("", "grip"),
        ("camera", ""),
        ("camera", "grip"),
    ):
        stated = grippers @ grip.inverse() if by_grip else grippers
        stated = moved @ stated if by_camera else stated
        shift = thing.check(images, reference, robot_poses=stated)
        assert shift.moved == bool(by_camera)
        assert ("another way" in shift.note) == bool(by_grip)
        again = thing.calibrate(images, robot_poses=stated)
        true = moved @ truth.base_from_tripod if by_camera else truth.base_from_tripod
        assert pose_distance_mm_deg(again.parent_from_child, true)[0] < 2
        assert ("another way" in again.verdict) == bool(by_grip)
    # From the disk it is the same map, so that its errors cancel.
    alone = Map.open(tmp_path / "thing").check(
        images[:1], reference, robot_poses=(moved @ grippers)[:1]
    )
    assert alone.same_map
    assert alone.moved
    assert "The camera, or the thing" in alone.note
