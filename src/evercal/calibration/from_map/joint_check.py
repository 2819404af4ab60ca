"""Joint values beside the images of a recording, before a hand-eye transform is known."""

from collections.abc import Sequence

import numpy as np

from evercal.calibration.from_map.image_pairs import ImagePair, image_pairs
from evercal.features.encoder import load_encoder
from evercal.geometry import spread
from evercal.recordings.frame import MIN_TRAIN_FRAMES, Recording
from evercal.recordings.poses.pose_evidence import motion_of_rays, motions_of_pairs
from evercal.robot.arm import Arm
from evercal.robot.joint_agreement import JointTest
from evercal.robot.joint_search import JointVerdict, joint_search
from evercal.robot.mount import Mount
from evercal.typing import Array

FRAMES = 40
"""Maximum number of frames of a recording that is inspected."""
PAIRS = 48
"""Maximum number of pairs."""
LEAST_PAIRS = 16
"""Number of pairs below which nothing is said of joints."""
_EPIPOLAR = 1e-3
"""Distance of inliers from their epipolar lines, at focal length 1."""
REPAIR = "'evercal inspect' writes a file for `joint_map`, which repairs it"


def joint_verdict(
    arm: Arm, values: Array, pairs: Sequence[ImagePair], mount: Mount
) -> JointVerdict | None:
    """Compare joint values (n, k) with pairs of n images; None for too few pairs."""
    motions = {}
    for i in spread(len(pairs), PAIRS):
        first, second = np.ascontiguousarray(pairs[i].rays[:, :, :2])
        motions[pairs[i][:2]] = motion_of_rays(first, second, _EPIPOLAR)
    known = motions_of_pairs(motions)
    if len(known.ends) < LEAST_PAIRS:
        return None
    return joint_search(JointTest(arm, values, known, mount))


def recorded_joints(recording: Recording, mount: Mount) -> JointVerdict | None:
    """Compare the joint values of a recording with some of its images; None without both."""
    frames = [f for f in recording.train if f.base_from_gripper and f.joints_rad]
    frames = [frames[i] for i in spread(len(frames), FRAMES)]
    if not recording.arm or len(frames) < MIN_TRAIN_FRAMES:
        return None
    pairs = image_pairs(frames, mount, load_encoder())
    values = np.array([frame.joints_rad for frame in frames])
    return joint_verdict(recording.arm, values, pairs, mount)


def joint_sentence(verdict: JointVerdict) -> str:
    """What is wrong with joint values that do not agree with the images."""
    if not verdict.readings:
        return (
            "joint values and images differ by"
            f" {verdict.stated.error_deg:.0f} deg (median rotation of pairs), and no other sense,"
            " zero, unit, order or coupling of joints fits: do they belong to these images and to"
            " this URDF?"
        )
    causes = ", or ".join("; ".join(one.mistakes) for one in verdict.readings)
    sentence = (
        f"{causes}: so rotations agree with the images to"
        f" {verdict.readings[0].error_deg:.1f} deg, as stated to {verdict.stated.error_deg:.1f} deg"
    )
    if len(verdict.readings) > 1:
        sentence += "; the images do not tell these apart"
    return sentence
