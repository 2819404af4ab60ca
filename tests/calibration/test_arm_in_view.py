"""A fixed camera by an arm of boxes in its images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.arm_in_view.fit import Fitter
from evercal.calibration.arm_in_view.solve import (
    calibrate_arm_in_view,
    chosen_frames,
    fit_arm,
    priors_of,
)
from evercal.calibration.arm_in_view.views import ArmViews
from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.recordings import ReadOptions, load_recording
from evercal.robot.link_shapes import robot_body
from evercal.robot.pose_errors import ArmErrors
from evercal.robot.robot_model import RobotModel
from tests import arm_cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("arm")
    arm_cell.write(folder)
    return folder


def _calibrated(folder: Path) -> Calibration:
    recording = load_recording(folder, None, None, ReadOptions(whole_robot=True))
    return calibrate_arm_in_view(recording, RobotModel(folder / "robot.urdf"))


def test_the_camera_is_estimated_without_a_start(cell: Path) -> None:
    """0.3 mm and 0.011 deg, from ten images of 320x240 at 1.4 m."""
    calibration = _calibrated(cell)
    mm, deg = pose_distance_mm_deg(
        calibration.parent_from_child, arm_cell.BASE_FROM_CAMERA
    )
    assert mm < 1.5
    assert deg < 0.06
    assert (
        calibration.uncertain_pose.squared_mahalanobis(arm_cell.BASE_FROM_CAMERA) < 17
    )
    assert calibration.sigma_mm < 4


def test_a_wide_lens(tmp_path: Path) -> None:
    """0.3 mm; 15 mm if its distortion is not stated."""
    lens = replace(arm_cell.CAMERA, distortion=(-0.25, 0.06, 0.0, 0.0))
    arm_cell.write(tmp_path, camera=lens)
    found = _calibrated(tmp_path).parent_from_child
    assert pose_distance_mm_deg(found, arm_cell.BASE_FROM_CAMERA)[0] < 3


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_a_wrong_focal_length_is_estimated(cell: Path, factor: float) -> None:
    """3 % of it are 40 mm at this distance."""
    options = ReadOptions(whole_robot=True)
    recording = load_recording(cell, None, None, options)
    frames = tuple(
        replace(frame, camera=frame.camera.zoomed(factor)) for frame in recording.train
    )
    model = RobotModel(cell / "robot.urdf")
    calibration = calibrate_arm_in_view(replace(recording, train=frames), model)
    truth = arm_cell.BASE_FROM_CAMERA
    assert pose_distance_mm_deg(calibration.parent_from_child, truth)[0] < 15
    assert calibration.uncertain_pose.squared_mahalanobis(truth) < 20
    assert "focal length" in calibration.verdict


def test_offsets_of_joints_are_estimated(cell: Path) -> None:
    """Of the elbow, 1 deg."""
    options = ReadOptions(whole_robot=True)
    recording = load_recording(cell, None, None, options)
    off = np.radians([0, 0, 1, 0])
    frames = []
    for frame in recording.train:
        assert frame.joints_rad is not None
        values = tuple((np.array(frame.joints_rad) - off).tolist())
        frames.append(replace(frame, joints_rad=values))
    model = RobotModel(cell / "robot.urdf")
    moved = replace(recording, train=tuple(frames))
    calibration = calibrate_arm_in_view(moved, model)
    offsets = np.degrees([joint.offset for joint in calibration.joints])
    assert offsets == pytest.approx([0, 0, 1, 0], abs=0.2)
    truth = arm_cell.BASE_FROM_CAMERA
    assert pose_distance_mm_deg(calibration.parent_from_child, truth)[0] < 4


def test_joint_values_of_other_images_are_refused(cell: Path, tmp_path: Path) -> None:
    """The arm is not where the values say."""
    folder = tmp_path / "shuffled"
    folder.mkdir()
    for file in cell.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    header, *rows = (cell / "joints.csv").read_text().splitlines()
    names = [row.partition(",")[0] for row in rows]
    others = rows[3:] + rows[:3]
    values = [row.partition(",")[2] for row in others]
    mixed = [f"{name},{value}" for name, value in zip(names, values, strict=True)]
    (folder / "joints.csv").write_text("\n".join([header, *mixed]))
    with pytest.raises(InputError, match="do the joint values belong"):
        _calibrated(folder)


def test_the_arm_may_leave_the_image(cell: Path) -> None:
    """A camera that sees none of it refuses."""
    options = ReadOptions(whole_robot=True)
    recording = load_recording(cell, None, None, options)
    away = arm_cell.BASE_FROM_CAMERA @ SE3.exp([0, 0, 0, 0, 3, 0])
    body = robot_body(RobotModel(cell / "robot.urdf"), arm_cell.NAMES)
    fitter = Fitter(ArmViews.of(chosen_frames(recording), body))
    with pytest.raises(InputError, match="not recognised"):
        fit_arm(fitter, priors_of(body, ArmErrors()), away)
