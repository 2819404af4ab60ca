"""A camera on the arm is found from its images and the gripper's poses, and so is the scene."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.eye_in_hand import lacks_camera_poses
from evercal.continual.learn_scene import LearnOptions, LearnReport, learn_scene
from evercal.continual.stage import StageOptions
from evercal.continual.strategies import STRATEGIES
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.localization.localizer import Localizer
from evercal.recordings import Recording, load_recording
from evercal.recordings.samples import FOLDER


def blind(scene: Recording) -> Recording:
    """The recording without what it says about the camera."""
    frames = (*scene.train, *scene.test)
    return Recording("arm", tuple(replace(f, base_from_camera=None) for f in frames), ())


@pytest.fixture(scope="module")
def hand() -> Recording:
    return load_recording(FOLDER / "bedroom" / "calibration" / "hand")


@pytest.fixture(scope="module")
def truth() -> SE3:
    told = json.loads((FOLDER / "bedroom" / "calibration" / "truth.json").read_text())
    pose = told["gripper_from_camera"]
    return SE3(np.array(pose["quaternion_wxyz"]), np.array(pose["translation_m"]))


@pytest.fixture(scope="module")
def learned(
    hand: Recording, truth: SE3, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, LearnReport]:
    store = tmp_path_factory.mktemp("wrist") / "cell.evercal"
    rough = truth @ SE3.exp([0.05, 0, 0, 0, 0.2, 0])
    options = LearnOptions(StageOptions(memory_share=0.3), gripper_from_camera=rough)
    return store, learn_scene(store, blind(hand), options)


def test_the_camera_is_found_on_the_gripper(learned: tuple[Path, LearnReport], truth: SE3) -> None:
    found = learned[1].hand_eye
    assert found is not None
    metres, radians = pose_distance(found.gripper_from_camera, truth)
    assert metres < 0.002
    assert np.rad2deg(radians) < 0.1
    covariance = np.array(found.covariance)
    shift = truth.translation_m - found.gripper_from_camera.translation_m
    turn = (found.gripper_from_camera.inverse() @ truth).log()[3:]
    error = np.concatenate([shift, turn])
    assert error @ np.linalg.solve(covariance, error) < 16.8  # 99 % of six dimensions
    assert found.given_mm == pytest.approx(50, abs=4)
    assert found.given_deg == pytest.approx(np.rad2deg(0.2), abs=0.3)
    assert found.doubts == ()


def test_the_scene_answers_in_the_base_frame(
    learned: tuple[Path, LearnReport], hand: Recording
) -> None:
    localizer = Localizer.open(learned[0])
    frame = hand.test[3]
    answer = localizer.localize(frame.read_image(), frame.camera)
    assert answer.base_from_camera is not None
    assert frame.base_from_camera is not None
    assert pose_distance(answer.base_from_camera, frame.base_from_camera)[0] < 0.003
    record = localizer.maps.scenes[0]
    assert record.frame_covariance is not None
    # The uncertainty of the camera on the gripper is in the answer.
    with_frame = answer.covariance
    localizer.maps.scenes[0] = replace(record, frame_covariance=None)
    without = localizer.localize(frame.read_image(), frame.camera).covariance
    assert with_frame is not None
    assert without is not None
    assert np.linalg.eigvalsh(with_frame - without).min() > -1e-12
    assert np.trace(with_frame[:3, :3]) > 1.01 * np.trace(without[:3, :3])


def test_what_is_a_wrist_recording(hand: Recording) -> None:
    assert lacks_camera_poses(blind(hand))
    assert not lacks_camera_poses(replace(hand, train=hand.test))
    assert not lacks_camera_poses(Recording("none", (), ()))


def test_rotation_about_one_axis_is_refused_before_any_work(
    hand: Recording, tmp_path: Path
) -> None:
    frames = tuple(
        replace(
            f, base_from_camera=None, base_from_gripper=SE3.exp([0.01 * i, 0, 0, 0, 0, 0.1 * i])
        )
        for i, f in enumerate(hand.test)
    )
    with pytest.raises(InputError, match="arm: the gripper turns about one axis only"):
        learn_scene(tmp_path / "store", Recording("arm", frames, ()), LearnOptions())
    assert not (tmp_path / "store").exists()


def test_a_network_cannot_find_it(hand: Recording, tmp_path: Path) -> None:
    options = LearnOptions(strategy=STRATEGIES["evercal_network"])
    with pytest.raises(InputError, match="only gripper poses are known"):
        learn_scene(tmp_path / "store", blind(hand), options)
