"""Poses at the images of a bag, from tf or from joint states and a URDF."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.formats.bags.file import JOINT_STATE, TF, BagFile
from evercal.recordings.formats.bags.tf_tree import TfTree, Transform, plain_name
from evercal.recordings.poses.kinematics import RobotModel, interpolate
from evercal.recordings.read_options import ReadOptions

_BASES = ("base_link", "base", "panda_link0", "fr3_link0", "fer_link0", "lbr_link_0", "link_base")
_GRIPPERS = (
    "tool0", "flange", "ee_link", "panda_hand", "fr3_hand", "fer_hand", "lbr_link_ee", "link_eef",
    "gripper_link", "tool_link",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class ImagePoses:
    """Poses at the images of a bag."""

    poses: SE3
    """(n,) base_from_gripper, or base_from_camera."""
    valid: NDArray[np.bool_]
    """(n,) whether each pose was recorded close enough to the image."""
    of_camera: bool
    notes: list[str]


def poses_at_images(
    bag: BagFile, stamps_ns: NDArray[np.int64], camera_frame: str, options: ReadOptions
) -> ImagePoses:
    """Interpolate the pose of the gripper at n images in `camera_frame`, at `stamps_ns` (n,)."""
    zero = int(stamps_ns[0])
    stamps = (stamps_ns - zero).astype(np.float64) * 1e-9
    if options.urdf is not None:
        return _from_joints(bag, stamps, zero, RobotModel(options.urdf), options)
    tree, times = _tf(bag, zero, options.pose_topic)
    base = _frame(bag, tree, options.base_frame, _BASES, "--base-frame")
    gripper = _frame(bag, tree, options.gripper_frame, _GRIPPERS, "--gripper-frame")
    poses, valid = tree.a_from_b(base, gripper, stamps)
    if not valid.any():
        _refuse_times(bag, stamps, times, "tf")
    of_camera = gripper == camera_frame
    owner = "the camera" if of_camera else "the gripper"
    notes = [f"poses of {owner} are those of {gripper} in {base}, from tf"]
    if not of_camera and camera_frame in tree.frames() and tree.connected(base, camera_frame):
        notes.append(
            f"tf also has the camera ({camera_frame}), which is not used; to use it, give"
            f" --gripper-frame {camera_frame}"
        )
    return ImagePoses(poses, valid, of_camera, notes)


def _tf(bag: BagFile, zero_ns: int, wanted: str | None) -> tuple[TfTree, list[float]]:
    topics = bag.topics(*TF)
    if not topics:
        joints = bag.topics(JOINT_STATE)
        instead = f", or give the robot's --urdf for {joints[0]}" if joints else ""
        raise InputError(
            f"{bag.path}: no tf in it, so there are no gripper poses; record /tf and"
            f" /tf_static{instead}. It holds {bag.contents()}"
        )
    _check_topic(bag, wanted, [t for t in topics if not t.endswith("tf_static")], "tf")
    tree, times = TfTree(str(bag.path), wanted), []
    for message in bag.messages(topics):
        for entry in message.content.transforms:
            stamp = None
            if not message.topic.endswith("tf_static"):
                stamp = message.seconds(entry.header, zero_ns)
                times.append(stamp)
            t, q = entry.transform.translation, entry.transform.rotation
            frames = entry.header.frame_id, entry.child_frame_id
            link = Transform(*frames, stamp, (q.w, q.x, q.y, q.z), (t.x, t.y, t.z))
            tree.add(link, message.topic.removesuffix("_static"))
    return tree, times


def _check_topic(bag: BagFile, wanted: str | None, topics: Sequence[str], what: str) -> None:
    if wanted is not None and wanted not in topics:
        raise InputError(
            f"{bag.path}: no {what} on --pose-topic {wanted}; it is on"
            f" {', '.join(topics) or 'no topic'}"
        )


def _frame(
    bag: BagFile, tree: TfTree, wanted: str | None, usual: Sequence[str], option: str
) -> str:
    frames = tree.frames()
    if wanted is not None:
        if plain_name(wanted) not in frames:
            raise InputError(
                f"{bag.path}: {option} {wanted}: no such frame in tf; it has {', '.join(frames)}"
            )
        return plain_name(wanted)
    names = [name for name in usual if name in frames]
    if len(names) != 1:
        which = f"it may be {' or '.join(names)}" if names else "no frame has a usual name"
        raise InputError(
            f"{bag.path}: name the frame with {option} ({which}); tf has {', '.join(frames)}"
        )
    return names[0]


def _refuse_times(
    bag: BagFile, stamps: NDArray[np.float64], times: Sequence[float], what: str
) -> NoReturn:
    covered = f"{min(times):.1f} to {max(times):.1f} s" if len(times) else "no time"
    raise InputError(
        f"{bag.path}: no image has a pose: images were taken at {stamps.min():.1f} to"
        f" {stamps.max():.1f} s after the first, {what} covers {covered}; are the clocks the same?"
    )


def _from_joints(
    bag: BagFile,
    stamps: NDArray[np.float64],
    zero_ns: int,
    model: RobotModel,
    options: ReadOptions,
) -> ImagePoses:
    base, gripper = model.chosen_links(options.base_frame, options.gripper_frame)
    topics = bag.topics(JOINT_STATE)
    if not topics:
        raise InputError(
            f"{bag.path}: no joint states in it for --urdf {options.urdf}; it holds"
            f" {bag.contents()}"
        )
    _check_topic(bag, options.pose_topic, topics, "joint states")
    tracks = _joint_tracks(bag, topics, zero_ns)
    needed = model.joints_between(base, gripper)
    values, valid = np.zeros((len(stamps), len(tracks))), np.ones(len(stamps), dtype=bool)
    times: Sequence[float] = ()
    for column, (name, track) in enumerate(tracks.items()):
        if name not in needed:
            continue
        if len(track) > 1 and options.pose_topic not in track:
            raise InputError(
                f"{bag.path}: joint {name} is on several topics, {', '.join(sorted(track))};"
                f" choose one with --pose-topic"
            )
        topic = options.pose_topic if options.pose_topic in track else next(iter(track))
        times, positions = zip(*track[topic], strict=True)
        values[:, column], here = interpolate(np.array(times), np.array(positions), stamps)
        valid &= here
    poses, notes = model.poses([*tracks], values, base, gripper, bag.path)
    if not valid.any():
        _refuse_times(bag, stamps, times, "the joint states")
    return ImagePoses(poses, valid, False, notes)


def _joint_tracks(
    bag: BagFile, topics: Sequence[str], zero_ns: int
) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """By joint and topic: pairs of seconds after `zero_ns` and position."""
    tracks: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for message in bag.messages(topics):
        stamp = message.seconds(message.content.header, zero_ns)
        for name, position in zip(message.content.name, message.content.position, strict=False):
            tracks[name][message.topic].append((stamp, float(position)))
    return tracks
