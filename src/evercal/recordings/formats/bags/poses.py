"""Where the gripper was at the images of a bag: from tf, or from joint states and a URDF."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.formats.bags.file import JOINT_STATE, TF, BagFile
from evercal.recordings.formats.bags.tf_tree import TfTree, plain
from evercal.recordings.poses.joint_states import interpolate
from evercal.recordings.poses.kinematics import RobotModel
from evercal.recordings.read_options import ReadOptions

_BASES = ("base_link", "base", "panda_link0", "fr3_link0", "fer_link0", "lbr_link_0", "link_base")
_GRIPPERS = (
    "tool0", "flange", "ee_link", "panda_hand", "fr3_hand", "fer_hand", "lbr_link_ee", "link_eef",
    "gripper_link", "tool_link",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Placed:
    """Poses at the images."""

    poses: SE3
    """(n,) base_from_gripper, or base_from_camera."""
    known: NDArray[np.bool_]
    """(n,) whether each is known."""
    of_camera: bool
    """Whether they are the camera's own poses."""
    notes: list[str]
    """What was chosen."""


def place_images(
    bag: BagFile, stamps_ns: NDArray[np.int64], camera_frame: str, options: ReadOptions
) -> Placed:
    """Finds the pose of the gripper at every image.

    Args:
        bag: open.
        stamps_ns: (n,) when the images were taken.
        camera_frame: that the images name.
        options: frames and URDF.

    Raises:
        InputError: No tf and no joint states, frames that are missing or cannot be guessed, or no
            image within the recorded poses.
    """
    if options.urdf is not None:
        return _from_joints(bag, stamps_ns, options)
    tree, times = _tf(bag, int(stamps_ns[0]), options.pose_topic)
    stamps = (stamps_ns - stamps_ns[0]).astype(np.float64) * 1e-9
    base = _frame(bag, tree, options.base_frame, _BASES, "--base-frame")
    gripper = _frame(bag, tree, options.gripper_frame, _GRIPPERS, "--gripper-frame")
    poses, known = tree.a_from_b(base, gripper, stamps)
    if not known.any():
        _refuse_apart(bag, stamps, times, "tf")
    of_camera = gripper == camera_frame
    whose = "the camera, which the images name as their frame," if of_camera else "the gripper"
    notes = [f"poses of {whose} are those of {gripper} in {base}, from tf"]
    if not of_camera and camera_frame in tree and tree.connected(base, camera_frame):
        notes.append(
            f"tf states the camera too ({camera_frame}); that is not used. If it is right, give"
            f" --gripper-frame {camera_frame}"
        )
    return Placed(poses, known, of_camera, notes)


def _tf(bag: BagFile, zero_ns: int, wanted: str | None) -> tuple[TfTree, NDArray[np.float64]]:
    """All transforms, and the times of the moving ones, in seconds after `zero_ns`."""
    topics = bag.topics(*TF)
    if not topics:
        joints = bag.topics(JOINT_STATE)
        instead = f", or give the robot's --urdf for {joints[0]}" if joints else ""
        raise InputError(
            f"{bag.path}: no tf in it, so nothing says where the gripper was; record /tf and"
            f" /tf_static{instead}. It holds {bag.contents()}"
        )
    _check_topic(bag, wanted, [t for t in topics if not t.endswith("tf_static")], "tf")
    tree, times = TfTree(str(bag.path), wanted), []
    for message in bag.messages(topics):
        for entry in message.content.transforms:
            stamp = None
            if not message.topic.endswith("tf_static"):
                at = entry.header.stamp.sec * 1_000_000_000 + entry.header.stamp.nanosec
                stamp = ((at or message.logged_ns) - zero_ns) * 1e-9
                times.append(stamp)
            moved, turned = entry.transform.translation, entry.transform.rotation
            tree.add(
                entry.header.frame_id,
                entry.child_frame_id,
                stamp,
                (moved.x, moved.y, moved.z),
                (turned.w, turned.x, turned.y, turned.z),
                message.topic.removesuffix("_static"),
            )
    return tree, np.array(times)


def _check_topic(bag: BagFile, wanted: str | None, topics: Sequence[str], what: str) -> None:
    if wanted is not None and wanted not in topics:
        raise InputError(
            f"{bag.path}: no {what} on --pose-topic {wanted}; it is on"
            f" {', '.join(topics) or 'none'}"
        )


def _frame(
    bag: BagFile, tree: TfTree, wanted: str | None, usual: Sequence[str], flag: str
) -> str:  # fmt: skip
    """The frame asked for, or the only one of the usual names."""
    frames = tree.frames()
    if wanted is not None:
        if plain(wanted) not in frames:
            raise InputError(
                f"{bag.path}: {flag} {wanted}: no such frame in tf; it has {', '.join(frames)}"
            )
        return plain(wanted)
    found = [name for name in usual if name in frames]
    if len(found) != 1:
        which = f"it may be {' or '.join(found)}" if found else "none has a usual name"
        raise InputError(
            f"{bag.path}: name the frame with {flag} ({which}); tf has {', '.join(frames)}"
        )
    return found[0]


def _refuse_apart(
    bag: BagFile, stamps: NDArray[np.float64], times: NDArray[np.float64], what: str
) -> None:
    """Raises for images none of which lies within what was recorded of the arm."""
    when = f"{times.min():.1f} to {times.max():.1f} s" if times.size else "no time"
    raise InputError(
        f"{bag.path}: no image has a pose: images were taken at {stamps.min():.1f} to"
        f" {stamps.max():.1f} s after the first, {what} covers {when}; are the clocks the same?"
    )


def _from_joints(bag: BagFile, stamps_ns: NDArray[np.int64], options: ReadOptions) -> Placed:
    """Forward kinematics of the joint states, interpolated at the images."""
    assert options.urdf is not None
    model = RobotModel(options.urdf)
    base, gripper = options.base_frame or model.base_link, options.gripper_frame
    gripper = gripper or model.end_link()
    topics = bag.topics(JOINT_STATE)
    if not topics:
        raise InputError(
            f"{bag.path}: no joint states in it for --urdf {options.urdf}; it holds"
            f" {bag.contents()}"
        )
    _check_topic(bag, options.pose_topic, topics, "joint states")
    zero = int(stamps_ns[0])
    tracks = _tracks(bag, topics, zero)
    needed = model.joints_between(base, gripper)
    missing = [name for name in needed if name not in tracks]
    if missing:
        raise InputError(
            f"{bag.path}: joint states lack {', '.join(missing)}, which {gripper} depends on; they"
            f" have {', '.join(tracks)}"
        )
    chosen = [_track(bag, name, tracks[name], options.pose_topic) for name in needed]
    stamps = (stamps_ns - zero).astype(np.float64) * 1e-9
    values, known = np.empty((len(stamps), len(needed))), np.ones(len(stamps), dtype=bool)
    for column, track in enumerate(chosen):
        times, positions = np.array(track).T
        values[:, column], seen = interpolate(times, positions, stamps)
        known &= seen
    if not known.any():
        times = np.array([at for at, _ in chosen[0]])
        _refuse_apart(bag, stamps, times, "the joint states")
    poses = model.base_from_gripper(needed, values, base, gripper)
    notes = [f"gripper poses are those of {gripper} in {base}, from {options.urdf.name}"]
    return Placed(poses, known, False, notes + model.beyond_limits(needed, values))


def _tracks(
    bag: BagFile, topics: Sequence[str], zero_ns: int
) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """By joint and topic: seconds after `zero_ns`, and positions."""
    found: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for message in bag.messages(topics):
        stamp = message.content.header.stamp
        at = stamp.sec * 1_000_000_000 + stamp.nanosec or message.logged_ns
        for name, position in zip(message.content.name, message.content.position, strict=False):
            track = found.setdefault(name, {}).setdefault(message.topic, [])
            track.append(((at - zero_ns) * 1e-9, float(position)))
    return found


def _track(
    bag: BagFile, joint: str, topics: dict[str, list[tuple[float, float]]], wanted: str | None
) -> list[tuple[float, float]]:
    """The positions of a joint on its only topic, or on the one asked for."""
    if wanted in topics:
        return topics[wanted]
    if len(topics) > 1:
        raise InputError(
            f"{bag.path}: joint {joint} is on several topics, {', '.join(sorted(topics))}; name"
            f" the one that holds with --pose-topic"
        )
    return next(iter(topics.values()))
