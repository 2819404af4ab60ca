"""Poses at the images of a bag, from tf or from joint states and a URDF."""

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Literal, NoReturn

import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.recordings.formats.bags.file import JOINT_STATE, TF, BagFile
from evercal.recordings.formats.bags.tf_tree import (
    BASES,
    GRIPPERS,
    STATIC,
    TfTree,
)
from evercal.recordings.poses.joint_tables import (
    arm_poses,
    interpolate,
    joint_reading,
)
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.read_options import ReadOptions
from evercal.robot.frame_names import FrameNames
from evercal.robot.robot_model import RobotModel
from evercal.typing import Array, BoolArray, IntArray, Pair


@frozen_arrays
class ImagePoses:
    """Poses at the images of a bag."""

    stated: RobotPoses
    """(n,) base_from_gripper, or base_from_camera."""
    valid: BoolArray
    """(n,) whether each pose was recorded close enough to the image."""
    owner: Literal["camera", "gripper"]
    """Owner of the poses."""
    notes: list[str]
    """Origin of the poses, one sentence each."""


def poses_at_images(
    bag: BagFile, stamps_ns: IntArray, camera_frame: str, options: ReadOptions
) -> ImagePoses:
    """Interpolate the pose of the gripper at n images in `camera_frame`, at `stamps_ns` (n,)."""
    zero = int(stamps_ns[0])
    stamps = (stamps_ns - zero).astype(float) * 1e-9
    if options.urdf:
        model = RobotModel(options.urdf, options.whole_robot, options.unchecked_joints)
        return _from_joints(bag, stamps, zero, model, options)
    tree, times = _tf(bag, zero, options.pose_topic)
    base = tree.frame(options.base_frame, BASES, "base_frame")
    gripper = tree.frame(options.gripper_frame, GRIPPERS, "gripper_frame")
    poses, valid = tree.a_from_b(base, gripper, stamps)
    if not valid.any():
        _refuse_times(bag, stamps, times, "tf")
    owner = "camera" if gripper == camera_frame else "gripper"
    notes = [f"poses of the {owner} are those of {gripper} in {base}, from tf"]
    has_camera = camera_frame in tree.frames() and tree.root(camera_frame) == tree.root(
        base
    )
    if has_camera and owner == "gripper":
        notes.append(
            f"tf also has the camera ({camera_frame}), which is not used; to use it, give"
            f" `gripper_frame` {camera_frame}"
        )
    names = FrameNames(base, "" if owner == "camera" else gripper)
    return ImagePoses(RobotPoses(None, None, poses, frames=names), valid, owner, notes)


def _tf(bag: BagFile, zero_ns: int, wanted: str | None) -> tuple[TfTree, Array]:
    topics = bag.topics(*TF)
    if not topics:
        joints = bag.topics(JOINT_STATE)
        instead = f", or give the robot's `urdf` for {joints[0]}" if joints else ""
        raise InputError(
            f"{bag.path}: no tf in it, so there are no gripper poses; record /tf and"
            f" /tf_static{instead}. It holds {bag.contents()}"
        )
    moving = [topic for topic in topics if not topic.endswith(STATIC)]
    bag.require_topic(wanted, moving, "transforms")
    tree = TfTree(str(bag.path), wanted)
    times = []
    for message in bag.messages(topics):
        times += tree.add_message(message, zero_ns)
    return tree, np.array(times)


def _refuse_times(bag: BagFile, stamps: Array, times: Array, what: str) -> NoReturn:
    covered = "no time"
    if times.size:
        covered = f"{times.min():.1f} to {times.max():.1f} s"
    raise InputError(
        f"{bag.path}: no image has a pose: images were taken at {stamps.min():.1f} to"
        f" {stamps.max():.1f} s after the first, {what} covers {covered}; are the clocks the same?"
    )


def _from_joints(
    bag: BagFile, stamps: Array, zero_ns: int, model: RobotModel, options: ReadOptions
) -> ImagePoses:
    base, gripper = model.chosen_links(options.base_frame, options.gripper_frame)
    topics = bag.topics(JOINT_STATE)
    if not topics:
        raise InputError(
            f"{bag.path}: no joint states in it for `urdf` {options.urdf}; it holds"
            f" {bag.contents()}"
        )
    bag.require_topic(options.pose_topic, topics, "joint states")
    tracks = _joint_tracks(bag, topics, zero_ns)
    values = np.zeros((len(stamps), len(tracks)))
    valid = np.ones(len(stamps), bool)
    times = np.empty(0)
    read = joint_reading(model, [*tracks], bag.path, options)
    joints = model.read_arm(base, gripper, read.joints, bag.path).joints
    known = read.of([joint for joint in joints if joint in read.joints])
    used = np.any(known.matrix, axis=0, keepdims=True)[0]
    for column, (name, track) in enumerate(tracks.items()):
        if not used[column]:
            continue
        topic = next(iter(track))
        if options.pose_topic in track:
            topic = options.pose_topic
        elif len(track) > 1:
            raise InputError(
                f"{bag.path}: joint {name} is on several topics, {', '.join(sorted(track))};"
                f" choose one with `pose_topic`"
            )
        times, positions = np.array(track[topic]).T
        values[:, column], is_valid = interpolate(times, positions, stamps)
        valid &= is_valid
    poses, notes = arm_poses(model, read, values, bag.path, options)
    if not valid.any():
        _refuse_times(bag, stamps, times, "the joint states")
    return ImagePoses(poses, valid, "gripper", notes)


def _joint_tracks(
    bag: BagFile, topics: Sequence[str], zero_ns: int
) -> dict[str, dict[str, list[Pair]]]:
    """By joint and topic: pairs of seconds after `zero_ns` and position."""
    tracks: dict[str, dict[str, list[Pair]]] = defaultdict(lambda: defaultdict(list))
    for message in bag.messages(topics):
        stamp = message.seconds(message.content.header, zero_ns)
        for name, position in zip(
            message.content.name, message.content.position, strict=False
        ):
            if math.isfinite(
                position
            ):  # drivers state nan for what they do not measure
                tracks[name][message.topic].append((stamp, float(position)))
    return tracks
