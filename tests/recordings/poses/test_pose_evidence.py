"""Comparison of stated rotations with images: correct poses pass, wrong ones are reported."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings import Frame, Recording, load_recording, write_image
from evercal.recordings.inspection import inspect_recording
from evercal.recordings.poses import pose_evidence
from evercal.recordings.poses.conventions import (
    numbers_from_poses,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.poses.pose_evidence import rotation_warnings
from evercal.recordings.samples import FOLDER

GRIPPER_FROM_CAMERA = SE3.exp([0.05, 0.02, 0.08, 0.4, -1.0, 0.7])
FLIP = SE3(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(3))


def stated(frames: tuple[Frame, ...]) -> SE3:
    return SE3.stack(
        [f.base_from_camera for f in frames if f.base_from_camera is not None]
    )


@pytest.fixture(scope="module")
def bedroom() -> tuple[Frame, ...]:
    """Rendered frames with exact poses."""
    return load_recording(FOLDER / "bedroom").train


@pytest.fixture(scope="module", autouse=True)
def matched_once() -> Iterator[None]:
    """Every pair of images is matched once for all tests."""
    real = pose_evidence.measured_motion
    cache = {}

    def cached(first: Frame, second: Frame) -> SE3 | None:
        key = first.image, second.image
        if key not in cache:
            cache[key] = real(first, second)
        return cache[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pose_evidence, "measured_motion", cached)
        yield


def test_measured_rotations_agree_with_true_poses(bedroom: tuple[Frame, ...]) -> None:
    poses = stated(bedroom)
    motions = pose_evidence.measured_motions(bedroom, poses)
    first, second = motions.ends.T
    measured = motions.turns
    assert len(measured) >= 8
    rotation = Rotation.from_quat(poses.rotation_wxyz, scalar_first=True)
    off = (
        Rotation.from_rotvec(measured).inv() * rotation[first].inv() * rotation[second]
    )
    assert np.rad2deg(np.median(off.magnitude())) < 1.0
    assert (
        np.rad2deg(np.median(np.linalg.norm(measured, axis=1)))
        > pose_evidence.MIN_ROTATION_DEG
    )


def reordered(poses: SE3) -> SE3:
    """x y z w read as w x y z."""
    return SE3(poses.rotation_wxyz[:, [1, 2, 3, 0]], poses.translation_m)


def as_degrees(poses: SE3) -> SE3:
    """Rotation vectors in degrees read as radians."""
    rotvec = Rotation.from_quat(poses.rotation_wxyz, scalar_first=True).as_rotvec(
        degrees=True
    )
    turned = Rotation.from_rotvec(rotvec).as_quat(scalar_first=True)
    return SE3(turned, poses.translation_m)


WRONG: dict[str, tuple[Callable[[SE3], SE3], str]] = {
    "inverse": (
        lambda poses: poses.inverse(),
        "they are camera_from_base, the inverse",
    ),
    "opengl": (lambda poses: poses @ FLIP, "they are with OpenGL's camera axes"),
    "both": (
        lambda poses: (poses @ FLIP).inverse(),
        "the inverse with OpenGL's camera axes",
    ),
    "order": (reordered, "they are in another order, xyzw:m"),
    "body": (
        lambda poses: poses @ GRIPPER_FROM_CAMERA,
        "those of another frame, at a fixed angle",
    ),
    "degrees": (as_degrees, "are angles in the stated unit and Euler order"),
}


@pytest.mark.parametrize("how", WRONG)
def test_wrong_camera_poses_are_reported(bedroom: tuple[Frame, ...], how: str) -> None:
    distort, message = WRONG[how]
    assert rotation_warnings(bedroom, stated(bedroom), True) == []
    (warning,) = rotation_warnings(bedroom, distort(stated(bedroom)), True, "wxyz")
    assert warning.startswith("the camera rotates differently from the images, by ")
    assert message in warning


def test_wrong_gripper_poses_are_reported(bedroom: tuple[Frame, ...]) -> None:
    gripper = stated(bedroom) @ GRIPPER_FROM_CAMERA.inverse()
    assert rotation_warnings(bedroom, gripper, False) == []
    # Any frame that is fixed to the gripper is as good.
    assert rotation_warnings(bedroom, gripper @ FLIP, False) == []
    (warning,) = rotation_warnings(bedroom, gripper.inverse(), False)
    assert "they are gripper_from_base, the inverse" in warning
    given = "wxyz"
    (warning,) = rotation_warnings(bedroom, reordered(gripper), False, given)
    assert "are in another order, xyzw:m (x y z qx qy qz qw" in warning
    (warning,) = rotation_warnings(bedroom, as_degrees(gripper), False)
    assert (
        "are angles in the stated unit" in warning
        or "the angles in another unit" in warning
    )


@pytest.mark.parametrize(
    ("written", "read"),
    [("kuka:m", "yaskawa:m"), ("yaskawa:m", "kuka:m"), ("ur:rad", "kuka:m:rad")],
)
def test_what_is_proposed_fits_translations_too(
    bedroom: tuple[Frame, ...], written: str, read: str
) -> None:
    """In the opposite order, angles rotate as their inverse does."""
    gripper = stated(bedroom) @ GRIPPER_FROM_CAMERA.inverse()
    numbers = numbers_from_poses(gripper, pose_convention(written))
    wrong = poses_from_numbers(numbers, pose_convention(read))
    (warning,) = rotation_warnings(bedroom, wrong, False, read)
    assert f"if they are in another order, {written[:3]}" in warning
    assert "inverse" not in warning


def test_still_camera_is_reported(bedroom: tuple[Frame, ...]) -> None:
    same = tuple(dataclasses.replace(f, image=bedroom[0].image) for f in bedroom)
    gripper = stated(bedroom) @ GRIPPER_FROM_CAMERA.inverse()
    (warning,) = rotation_warnings(same, gripper, False)
    assert warning.startswith(
        "the gripper rotates and the images hardly do; does the camera stand still"
    )


def test_images_without_texture_give_no_warning(tmp_path: Path) -> None:
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    poses = SE3.exp(np.linspace([0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 2, 0], 20))
    blank = tmp_path / "blank.png"
    write_image(blank, np.full((48, 64, 3), 128, np.uint8))
    frames = tuple(Frame(str(i), blank, camera, pose) for i, pose in enumerate(poses))
    assert rotation_warnings(frames, poses, True) == []


def test_wrist_recordings_are_inspected_by_gripper_poses(
    bedroom: tuple[Frame, ...],
) -> None:
    gripper = stated(bedroom) @ GRIPPER_FROM_CAMERA.inverse()

    def warned(poses: SE3) -> tuple[str, ...]:
        frames = tuple(
            dataclasses.replace(f, base_from_camera=None, base_from_gripper=pose)
            for f, pose in zip(bedroom, poses, strict=True)
        )
        inspection = inspect_recording(Recording("wave", frames, ()))
        assert (inspection.poses, inspection.train) == ("gripper", len(frames))
        return inspection.warnings

    assert warned(gripper) == ()
    (millimetres,) = warned(SE3(gripper.rotation_wxyz, 1000 * gripper.translation_m))[
        :1
    ]
    assert "farther than arms reach; are the poses in millimetres?" in millimetres
    (nowhere,) = warned(SE3(gripper.rotation_wxyz, 1e-6 * gripper.translation_m))
    assert "stand at one point, rotating by" in nowhere
    assert "in metres?" in nowhere
    (inverse,) = warned(gripper.inverse())
    assert "gripper_from_base, the inverse" in inverse


def test_many_cameras_are_summarised_in_one_line(bedroom: tuple[Frame, ...]) -> None:
    camera = bedroom[0].camera
    frames = tuple(
        dataclasses.replace(
            f, camera=dataclasses.replace(camera, fx=camera.fx + i / 10)
        )
        for i, f in enumerate(bedroom)
    )
    (line,) = inspect_recording(Recording("phone", frames, ())).cameras
    assert f"{len(frames)} sets of intrinsics" in line
    assert pose_distance(stated(frames), stated(bedroom))[0].max() == 0
