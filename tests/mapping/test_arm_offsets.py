"""Offsets of joints in bundle adjustment: their size, uncertainty, and what stays open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evercal.geometry import SE3
from evercal.mapping.arm_offsets import joint_slopes, with_offsets
from evercal.mapping.build import MapOptions
from evercal.mapping.bundle_adjustment import BundleAdjustment
from evercal.mapping.bundle_equations import Adjustment
from evercal.mapping.stated_errors import StatedErrors
from evercal.recordings.frame import Frame
from evercal.robot.arm import Arm, MovingJoint
from evercal.robot.arm_offsets import ArmOffsets
from evercal.robot.mount import EYE_IN_HAND, EYE_TO_HAND, Mount

from .projected_tracks import CAMERA, FRAMES, world

X, Y, Z = np.eye(3)
ARM = Arm(
    ("pan", "lift", "elbow", "wrist", "roll"),
    tuple(
        MovingJoint(SE3.from_translation(at).matrix(), axis, True, i)
        for i, (at, axis) in enumerate(
            ((0.1 * Z, Z), (0.05 * Z, Y), (0.4 * Z, Y), (0.4 * X, Y), (0.1 * X, X))
        )
    ),
    SE3.from_translation(0.1 * X).matrix(),
)
FORWARD = SE3.from_matrix(
    np.block(
        [
            [np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.zeros((3, 1))],
            [0, 0, 0, 1],
        ]
    )
)
MOUNT = FORWARD @ SE3.from_translation((0.02, 0.05, 0.03))


def adjusted(
    offsets_deg: tuple[float, ...], mount: Mount, moving: int = 5
) -> Adjustment:
    """An adjustment of frames of an arm, of which the first `moving` joints move."""
    rng = np.random.default_rng(3)
    joints = np.deg2rad(rng.uniform(-20, 20, (FRAMES, 5)) * (1, 1, 1, 1, 3))
    joints[:, moving:] = 0.1
    offsets = np.deg2rad(offsets_deg)
    true = ARM.poses(joints)
    stated = ARM.poses(joints - offsets)
    wrist = mount.moves
    # A fixed camera looks at the arm from 2 m away.
    turned = SE3.exp(np.array([0, 0, 0, 0, 0, np.pi]))
    camera = (
        MOUNT if wrist else SE3.from_translation((2.5, 0.0, 0.6)) @ turned @ FORWARD
    )
    truth, restated = (
        poses @ camera if wrist else poses.inverse() @ camera
        for poses in (true, stated)
    )
    made = world(noise_px=0.1, truth=truth, every=2)
    frames = [
        Frame(
            str(i),
            np.zeros((1, 1, 3), np.uint8),
            CAMERA,
            pose,
            gripper,
            joints_rad=tuple(q),
        )
        for i, (pose, gripper, q) in enumerate(
            zip(restated, stated, joints - offsets, strict=True)
        )
    ]
    begun = ArmOffsets.start(ARM, mount, np.zeros(5))
    options = replace(MapOptions().for_hand_eye(mount).bundle, intrinsics=False)
    return BundleAdjustment(
        restated,
        [CAMERA] * FRAMES,
        StatedErrors(
            np.zeros((FRAMES, 6)),
            SE3.stack([camera] * FRAMES) if wrist else restated,
            joint_slopes(frames, begun),
        ),
        options,
    ).solve(made.tracks)


@pytest.mark.parametrize("mount", [EYE_IN_HAND, EYE_TO_HAND])
def test_offsets_are_estimated_from_images(mount: Mount) -> None:
    result = adjusted((0, 0.8, -1.1, 0.6, 0), mount)
    offsets = np.rad2deg(result.offsets)
    sigma = np.sqrt(np.diag(result.offsets_covariance))
    assert offsets == pytest.approx([0, 0.8, -1.1, 0.6, 0], abs=0.1)
    assert np.rad2deg(sigma[1:4]).max() < 0.12
    assert result.offsets_known.tolist() == [False, True, True, True, False]


def test_a_perfect_arm_has_small_offsets() -> None:
    result = adjusted((0, 0, 0, 0, 0), EYE_IN_HAND)
    assert np.abs(np.rad2deg(result.offsets)).max() < 0.02
    assert np.rad2deg(result.offsets_prior).max() < 0.1


def test_an_offset_that_no_image_shows_is_as_uncertain_as_that_of_others() -> None:
    """Behind the last joint that moves, an offset is one of the mount, and so is its own."""
    result = adjusted((0, 1.0, -1.5, 0, 0), EYE_IN_HAND, moving=3)
    assert result.offsets_known.tolist() == [False, True, False, False, False]
    sigma = np.sqrt(np.diag(result.offsets_covariance))
    assert sigma[3] > 0.5 * result.offsets_prior[3]
    assert np.rad2deg(result.offsets_prior[3]) > 0.5


def test_frames_keep_the_transform_of_gripper_and_camera() -> None:
    joints = np.array([0.1, 0.2, -0.3, 0.4, 0.5])
    gripper = ARM.poses(joints[None])[0]
    offsets = ArmOffsets.start(ARM, EYE_IN_HAND, np.full(5, 0.02))
    frame = Frame("a", np.zeros((1, 1, 3), np.uint8), CAMERA, gripper @ MOUNT, gripper)
    (same,) = with_offsets([frame], offsets)
    assert same is frame
    (moved,) = with_offsets([replace(frame, joints_rad=tuple(joints))], offsets)
    assert moved.base_from_gripper is not None
    assert moved.base_from_camera is not None
    change = moved.base_from_gripper.inverse() @ moved.base_from_camera
    assert np.allclose(change.matrix(), MOUNT.matrix())
    assert np.allclose(
        moved.base_from_gripper.matrix(), ARM.poses(joints[None] + 0.02)[0].matrix()
    )


def test_a_fixed_camera_keeps_its_place_in_the_base() -> None:
    joints = np.array([0.1, 0.2, -0.3, 0.4, 0.5])
    gripper = ARM.poses(joints[None])[0]
    camera = SE3.from_translation((1.0, 0.2, 0.5))
    offsets = ArmOffsets.start(ARM, EYE_TO_HAND, np.full(5, 0.02))
    pose = gripper.inverse() @ camera
    image = np.zeros((1, 1, 3), np.uint8)
    (moved,) = with_offsets(
        [Frame("a", image, CAMERA, pose, gripper, joints_rad=tuple(joints.tolist()))],
        offsets,
    )
    assert moved.base_from_gripper is not None
    assert moved.base_from_camera is not None
    place = moved.base_from_gripper @ moved.base_from_camera
    assert np.allclose(place.matrix(), camera.matrix())
