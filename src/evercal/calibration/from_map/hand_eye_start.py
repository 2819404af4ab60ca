"""A first hand-eye transform from images and gripper poses; bundle adjustment refines it.

Features of similar frames are matched. The transform minimises the distances of matches from their
epipolar lines, from rotations all around, see `epipolar_fit`.

A camera on the gripper moves in the base. A fixed camera moves, as the gripper sees it, around the
thing that the gripper holds, with the inverse poses.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.calibration.from_map.epipolar_fit import EpipolarFit, first_rotation
from evercal.calibration.from_map.image_pairs import (
    MATCHING_SIDE,
    ImagePair,
    image_pairs,
)
from evercal.calibration.from_map.joint_check import (
    REPAIR,
    joint_sentence,
    joint_verdict,
)
from evercal.calibration.pose_pairs.checks import require_rotations
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.features.encoder import Encoder
from evercal.geometry import SE3
from evercal.mapping.arm_offsets import has_joints, with_offsets
from evercal.mapping.selection import spread_poses
from evercal.progress import OnProgress
from evercal.recordings.frame import (
    Frame,
    Recording,
    stated_grippers,
)
from evercal.recordings.held_out import require_frames
from evercal.recordings.stale_poses import stale_frames
from evercal.robot.arm import Arm
from evercal.robot.arm_offsets import ArmOffsets
from evercal.robot.mount import EYE_IN_HAND, EYE_TO_HAND, Mount
from evercal.typing import Array, IntArray

FRAMES = 120
"""Maximum number of frames, spread by pose."""
AGREE_DEG = 0.5
"""Largest median distance of the matches of a pair that agrees with the transform."""
LEAST_ROTATION_DEG = 5.7
"""Least root mean square angle between frames about each of two axes."""
LEAST_IMAGE_PAIRS = 6
"""Least number of pairs that agree."""
LEAST_SHARE = 0.3
"""Least share of the pairs that agree: before a chessboard half of them match the wrong squares."""
SURE_SHARE = 0.8
"""If this share of the pairs agrees, the other mount is not tried. With a wrong mount, 30 % of the
pairs can agree."""


@frozen_arrays
class HandEyeStart:
    """A first transform from the camera to what it is mounted on."""

    parent_from_camera: SE3
    """gripper_from_camera of a camera on the gripper, base_from_camera of a fixed one."""
    mount: Mount
    pairs: int
    """Number of image pairs that agree with it."""
    of_pairs: int
    """Number of image pairs with matches."""
    matches: tuple[ImagePair, ...] = ()
    """The pairs that agree."""
    distance_deg: float = 0.0
    """Median angle of matches from their epipolar planes, median of the pairs."""
    arm: ArmOffsets | None = None
    """First offsets of the joints, where joint values are stated."""
    confirmed: frozenset[str] = frozenset()
    """Names of frames whose matches agree with it in more pairs than not."""

    def posed(self, recording: Recording, frames: Sequence[Frame]) -> Recording:
        """The recording with rough camera poses of `frames`; its other ones count as untracked."""
        if self.arm:
            frames = with_offsets(frames, self.arm)
        poses = scene_from_parent(frames, self.mount) @ self.parent_from_camera
        pairs = zip(frames, poses, strict=True)
        train = [replace(frame, base_from_camera=pose) for frame, pose in pairs]
        untracked = recording.untracked + len(recording.train) - len(frames)
        return replace(recording, train=tuple(train), untracked=untracked)


class Joints(NamedTuple):
    """Joint values of n frames."""

    arm: Arm
    values: Array
    """(n, k)."""

    def matrices(self, offsets: Array, mount: Mount) -> Array:
        """(n, 4, 4) as `scene_from_parent`, with offsets (k,)."""
        poses = self.arm.poses(self.values + offsets * self.arm.free())
        return mount.scene_from_parent(poses).matrix()


def scene_from_parent(frames: Sequence[Frame], mount: Mount) -> SE3:
    """(n,) poses that move the camera: base_from_gripper, or gripper_from_base of a fixed one."""
    return mount.scene_from_parent(stated_grippers(frames))


def gripper_frames(recording: Recording) -> tuple[Frame, ...]:
    """Training frames with a gripper pose; too few are refused."""
    frames = tuple(f for f in recording.train if f.base_from_gripper)
    require_frames(replace(recording, train=frames))
    if stale := stale_frames(frames):
        raise InputError(f"{recording.name}: {stale}")
    return frames


def hand_eye_start(
    recording: Recording,
    frames: Sequence[Frame],
    mount: Mount,
    encoder: Encoder,
    on_progress: OnProgress,
    side: int = MATCHING_SIDE,
) -> HandEyeStart:
    """Estimate the transform of a camera from frames that all have `base_from_gripper`.

    Features are matched in images whose shorter side has at most `side` pixels. If the recording
    has an arm and the frames state joint values, their offsets are estimated, too.
    """
    arm = recording.arm if has_joints(frames) else None
    poses = scene_from_parent(frames, mount)
    require_rotations(poses, LEAST_ROTATION_DEG, LEAST_ROTATION_DEG)
    if len(frames) > FRAMES:
        spread = spread_poses(poses, FRAMES)
        frames = [frames[i] for i in spread]
        poses = poses[spread]
    pairs = image_pairs(frames, mount, encoder, on_progress, side)
    joints = arm and Joints(arm, np.array([frame.joints_rad for frame in frames]))
    if joints:
        verdict = joint_verdict(joints.arm, joints.values, pairs, mount)
        if verdict and verdict.readings:
            raise InputError(f"{joint_sentence(verdict)}; {REPAIR}")
    try:
        start = start_from_matches(poses, pairs, mount, joints)
    except InputError:
        _refuse_other_mount(poses.inverse(), pairs, mount, None)
        raise
    if start.pairs < SURE_SHARE * start.of_pairs:
        _refuse_other_mount(poses.inverse(), pairs, mount, start)
    votes = np.bincount(_ends(start.matches), minlength=len(frames))
    least = np.maximum(np.bincount(_ends(pairs), minlength=len(frames)) / 2, 1)
    judged = zip(frames, votes >= least, strict=True)
    names = frozenset(frame.name for frame, agrees in judged if agrees)
    return replace(start, confirmed=names)


def _ends(pairs: Sequence[ImagePair]) -> IntArray:
    """(2 n,) numbers of the frames of n pairs."""
    return np.array([pair[:2] for pair in pairs], np.int64).ravel()


def _refuse_other_mount(
    poses: SE3, pairs: Sequence[ImagePair], mount: Mount, start: HandEyeStart | None
) -> None:
    """Refuse a recording whose images fit the inverse poses better."""
    rivals = []
    for other in (EYE_IN_HAND, EYE_TO_HAND):
        with suppress(InputError):
            rivals.append(start_from_matches(poses, pairs, other))
    if not rivals:
        return
    rival = min(rivals, key=lambda rival: rival.distance_deg)
    if start and rival.distance_deg > start.distance_deg / 2:
        return
    another = "the camera moves with the gripper ('evercal learn MAP RECORDING --calibration FILE')"
    if mount.moves:
        another = "the camera stands still and shows what the gripper holds ('evercal eye-to-hand')"
    raise InputError(
        f"the inverse poses agree with the images in {rival.pairs} of {rival.of_pairs} pairs of"
        f" frames: either the poses are those of the base in the gripper, then invert them, or"
        f" {another}"
    )


def start_from_matches(
    poses: SE3, pairs: Sequence[ImagePair], mount: Mount, joints: Joints | None = None
) -> HandEyeStart:
    """Solve for the transform from pairs between n frames with `scene_from_parent` (n,)."""
    if len(pairs) < LEAST_IMAGE_PAIRS:
        raise InputError(
            f"only {len(pairs)} pairs of images show the same place from two sides, at least"
            f" {LEAST_IMAGE_PAIRS} are needed: record more views that overlap, of a place with"
            " texture"
        )
    epipolar = EpipolarFit(poses, pairs, mount)
    epipolar.rotation = first_rotation(poses, pairs, mount)
    starts = epipolar.starts()
    centre = np.mean(starts, axis=0)
    largest = np.deg2rad(AGREE_DEG)
    fits = [epipolar.solve(start, centre) for start in starts]
    best = min(fits, key=lambda x: np.minimum(epipolar.medians(x), largest).mean())
    arm = None
    if joints:
        epipolar.moving = lambda offsets: joints.matrices(offsets, mount)
        still = np.zeros(len(joints.arm.joints))
        best = epipolar.solve(np.r_[best, still], np.r_[centre, still])
        arm = ArmOffsets.start(joints.arm, mount, best[6:] * joints.arm.free())
    distance = epipolar.medians(best)
    agree = distance < largest
    if agree.sum() < max(LEAST_IMAGE_PAIRS, LEAST_SHARE * len(agree)):
        causes = (
            "the poses belong to these images, that they are poses of the gripper in the base"
            " (not the inverse), and the order of their quaternions or angles"
        )
        if joints:
            causes = (
                "the joint values belong to these images and to this URDF; other senses, zeros,"
                " units, orders and couplings of its joints were tried"
            )
        raise InputError(
            f"the gripper's motion and the images agree in only {agree.sum()} of {len(agree)} pairs"
            f" of frames: check that {causes}"
        )
    if epipolar.share_in_front(best) < 0.5:
        raise InputError(
            "the gripper's motion and the images agree only mirrored: all points would lie behind"
            " the camera. Switch the mirror of the camera off, or convert the poses of a"
            " left-handed frame"
        )
    return HandEyeStart(
        epipolar.transform(best),
        mount,
        int(agree.sum()),
        len(pairs),
        tuple(pairs[i] for i in np.flatnonzero(agree).tolist()),
        float(np.rad2deg(np.median(distance))),
        arm,
    )
