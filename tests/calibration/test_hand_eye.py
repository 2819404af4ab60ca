"""A camera on the gripper is calibrated from its images and gripper poses, and its scene mapped."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.from_map.hand_eye import verdict_of
from evercal.calibration.learned import calibration_at, calibration_of
from evercal.calibration.verdict import TIERS, tier
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.learning.report import LearnReport
from evercal.localization.localizer import Localizer
from evercal.map import Map
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore, stored_scenes
from evercal.recordings import Recording, load_recording
from evercal.recordings.frame import lacks_camera_poses
from evercal.recordings.samples import FOLDER

Learned = tuple[Path, LearnReport]


def without_camera_poses(recording: Recording) -> Recording:
    """All frames with gripper poses only."""
    frames = (*recording.train, *recording.test)
    return Recording(
        "arm", tuple(replace(f, base_from_camera=None) for f in frames), ()
    )


@pytest.fixture(scope="module")
def hand() -> Recording:
    return load_recording(FOLDER / "bedroom" / "calibration" / "hand")


@pytest.fixture(scope="module")
def truth() -> SE3:
    content = json.loads(
        (FOLDER / "bedroom" / "calibration" / "truth.json").read_text()
    )
    pose = content["gripper_from_camera"]
    return SE3(np.array(pose["quaternion_wxyz"]), np.array(pose["translation_m"]))


@pytest.fixture(scope="module")
def learned(
    hand: Recording, truth: SE3, tmp_path_factory: pytest.TempPathFactory
) -> Learned:
    folder = tmp_path_factory.mktemp("wrist") / "cell"
    rough = truth @ SE3.exp([0.05, 0, 0, 0, 0.2, 0])
    arm = without_camera_poses(hand)
    few = replace(arm, train=arm.train[:: len(arm.train) // 14][:14])
    report = Map.open(folder).learn(few, gripper_from_camera=rough)
    return folder, report


def test_gripper_from_camera_within_its_covariance(
    learned: Learned, truth: SE3
) -> None:
    whole = learned[1]
    report = learned[1].hand_eye
    assert (whole.train_frames, whole.held_out_frames) == (14, 0)
    assert whole.frames_kept >= 8
    assert report is not None
    estimate = report.parent_from_camera
    metres, radians = pose_distance(estimate.pose, truth)
    assert metres < 0.002
    assert np.rad2deg(radians) < 0.1
    assert estimate.squared_mahalanobis(truth) < 16.8  # 99 % for six dimensions
    assert report.given_mm == pytest.approx(50, abs=4)
    assert report.given_deg == pytest.approx(np.rad2deg(0.2), abs=0.3)
    assert report.warnings == ()


def test_the_map_keeps_the_calibration(learned: Learned, tmp_path: Path) -> None:
    folder, report = learned
    assert report.hand_eye is not None
    shutil.copytree(folder, tmp_path / "cell")
    cell = Map.open(tmp_path / "cell")
    calibration = cell.calibration()
    assert (calibration.mount, calibration.parent_frame) == ("eye_in_hand", "gripper")
    assert tier(calibration) in TIERS
    estimate = report.hand_eye.parent_from_camera
    assert max(pose_distance(calibration.parent_from_child, estimate.pose)) < 1e-12
    np.testing.assert_array_equal(calibration.covariance, estimate.covariance)
    assert calibration.camera == cell.localizer.contents.scenes[0].adjusted_camera
    assert calibration.created == report.hand_eye.calibration.created != ""
    cell.rename("arm", "bench")
    assert (
        calibration_at(tmp_path / "cell").to_dict()
        == cell.calibration("bench").to_dict()
    )
    assert calibration_at(f"{tmp_path / 'cell'}:bench").source["scene"] == "bench"
    with pytest.raises(InputError, match=r"scene 'arm': map .* has only bench"):
        calibration_at(f"{tmp_path / 'cell'}:arm")
    cell.merge(folder)
    with pytest.raises(
        InputError, match="bench, arm each have a calibration; name one"
    ):
        calibration_at(tmp_path / "cell")
    file = tmp_path / "wrist.json"
    calibration.write(file)
    assert calibration_at(file).to_dict() == calibration.to_dict()
    # As in the report of a fixed camera: images, their residuals, and causes that sum to the whole.
    assert len(calibration.images) > 10
    assert all(
        0 < (image.residual_mm or 0) < 5 for image in calibration.images if image.used
    )
    parts = [term.translation_mm for term in calibration.error_terms]
    assert np.linalg.norm(parts) == pytest.approx(calibration.sigma_mm)
    sentences = verdict_of(calibration, ["the clocks differ"], "turn more")
    assert sentences == "Do not rely on it: the clocks differ. Turn more."


def test_a_report_is_read_again(learned: Learned) -> None:
    folder, report = learned
    [stored] = stored_scenes(folder).values()
    stored.pop("made", None)
    assert json.loads(json.dumps(report.to_dict())) == stored
    read = LearnReport.from_stored(report.to_dict())
    assert json.loads(json.dumps(read.to_dict())) == stored
    # Version 0.2.0 stored the calibration beside how it was estimated.
    calibration = Map.open(folder).calibration()
    report_before = dict(stored["hand_eye"])
    beside = {name: report_before.pop(name) for name in calibration.to_dict()}
    before = {**stored, "hand_eye": report_before, "calibration": beside}
    assert calibration_of(before).to_dict() == calibration.to_dict()
    del before["calibration"]
    with pytest.raises(InputError, match=r"before version 0\.2; learn it again"):
        calibration_of(before)


def test_a_map_without_gripper_poses_has_no_calibration(
    hall_map: MapContents, tmp_path: Path
) -> None:
    store = MapStore(
        tmp_path / "map", MapContents(hall_map.encoder, hall_map.short_side)
    )
    store.commit(hall_map.scenes[0], {"hand_eye": None})
    with pytest.raises(InputError, match="was not learned from gripper poses"):
        calibration_at(tmp_path / "map")
    with pytest.raises(
        InputError, match="map:hall: was not learned from gripper poses"
    ):
        Map.open(tmp_path / "map").calibration("hall")


def test_images_are_located_in_the_base_frame(
    learned: Learned, hand: Recording
) -> None:
    contents = Localizer.open(learned[0]).contents
    scene = contents.scenes[0]
    frame = hand.test[3]
    assert scene.frame.base_covariance is not None
    without_error = replace(scene, frame=replace(scene.frame, base_covariance=None))
    exact = MapContents(contents.encoder, contents.short_side, [without_error])
    estimates = [Localizer(c).localize(frame.read_image()) for c in (contents, exact)]
    assert estimates[0].base_from_camera is not None
    assert frame.base_from_camera is not None
    assert (
        pose_distance(estimates[0].base_from_camera, frame.base_from_camera)[0] < 0.003
    )
    # The covariance contains the error of the camera on the gripper.
    wide, narrow = (estimate.covariance for estimate in estimates)
    assert wide is not None
    assert narrow is not None
    assert np.linalg.eigvalsh(wide - narrow).min() > -1e-12
    assert np.trace(wide[:3, :3]) > 1.01 * np.trace(narrow[:3, :3])


def test_recordings_without_camera_poses_are_recognised(hand: Recording) -> None:
    assert lacks_camera_poses(without_camera_poses(hand))
    assert not lacks_camera_poses(replace(hand, train=hand.test))
    assert not lacks_camera_poses(Recording("none", (), ()))


def test_rotation_about_one_axis_is_refused(hand: Recording, tmp_path: Path) -> None:
    poses = (SE3.exp([0.01 * i, 0, 0, 0, 0, 0.1 * i]) for i in range(len(hand.test)))
    frames = tuple(
        replace(f, base_from_camera=None, base_from_gripper=pose)
        for f, pose in zip(hand.test, poses, strict=True)
    )
    with pytest.raises(InputError, match="arm: parallel axes: the gripper turned"):
        Map.open(tmp_path / "map").learn(Recording("arm", frames, ()))
    assert not (tmp_path / "map").exists()


@pytest.mark.parametrize("count", [1, 2, 7])
def test_too_few_images_are_refused(
    count: int, hand: Recording, tmp_path: Path
) -> None:
    arm = without_camera_poses(hand)
    few = replace(arm, train=arm.train[:count])
    with pytest.raises(
        InputError, match=rf"^scene 'arm': {count} training frames are too few"
    ):
        Map.open(tmp_path / "map").learn(few)
