"""Poses at the images of a bag, from tf or from joint states and a URDF."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, NoReturn

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.formats.bags.file import JOINT_STATE, TF, BagFile
from evercal.recordings.poses.joint_tables import interpolate, poses_of_arm
from evercal.recordings.poses.pose_track import PoseTrack
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.read_options import ReadOptions
from evercal.robot.robot_model import RobotModel
from evercal.typing import Array, BoolArray, IntArray

_BASES = (
    "base_link",
    "base",
    "panda_link0",
    "fr3_link0",
    "fer_link0",
    "lbr_link_0",
    "link_base",
)
_GRIPPERS = (
    "tool0", "flange", "ee_link", "panda_hand", "fr3_hand", "fer_hand", "lbr_link_ee", "link_eef",
    "gripper_link", "tool_link",
)  # fmt: skip


class _Transform(NamedTuple):
    """One TransformStamped, parent_from_child."""

    parent: str
    child: str
    stamp_s: float | None  # None if static
    quaternion: tuple[float, ...]  # wxyz
    translation: tuple[float, ...]


@dataclass
class _Edge:
    """Transforms of one child frame from one topic; moving ones take precedence."""

    moving: list[_Transform] = field(default_factory=list)
    static: list[_Transform] = field(default_factory=list)

    @property
    def transforms(self) -> list[_Transform]:
        return self.moving or self.static[-1:]

    @property
    def parents(self) -> set[str]:
        return {transform.parent for transform in (*self.moving, *self.static)}


class _TfTree:
    """Transforms, added in any order; `topic` is used if several topics move one frame."""

    def __init__(self, source: str, topic: str | None = None) -> None:
        self._source = source
        self._topic = topic
        self._edges: dict[str, dict[str, _Edge]] = {}  # by child and topic

    def add(self, transform: _Transform, topic: str) -> None:
        """Add a transform of a topic; /tf_static belongs to /tf."""
        length = float(np.linalg.norm(transform.quaternion))
        parent = plain_name(transform.parent)
        child = plain_name(transform.child)
        if not (abs(length - 1) < 1e-2 and np.isfinite(transform.translation).all()):
            raise InputError(
                f"{self._source}: tf {parent} -> {child}: quaternion (w x y z)"
                f" {transform.quaternion}, translation {transform.translation}: no rigid transform;"
                f" repair the program that publishes it"
            )
        edge = self._edges.setdefault(child, {}).setdefault(topic, _Edge())
        part = edge.static if transform.stamp_s is None else edge.moving
        part.append(transform._replace(parent=parent, child=child))

    def frames(self) -> tuple[str, ...]:
        """All frames, parents before children."""
        parents = {
            p
            for topics in self._edges.values()
            for e in topics.values()
            for p in e.parents
        }
        return tuple(
            sorted({*parents, *self._edges}, key=lambda f: (len(self._chain(f)), f))
        )

    def connected(self, a: str, b: str) -> bool:
        return self._chain(a)[-1] == self._chain(b)[-1]

    def a_from_b(self, a: str, b: str, stamps_s: Array) -> tuple[SE3, BoolArray]:
        """Interpolate (n,) poses of frame b in frame a, and whether each is valid."""
        up = self._chain(a)
        down = self._chain(b)
        for child in (frame for frame in (*up, *down) if frame in self._edges):
            self._refuse_ambiguous(child)
        if up[-1] != down[-1]:
            raise InputError(
                f"{self._source}: tf has no chain between {a!r} and {b!r}: their roots are"
                f" {up[-1]!r} and {down[-1]!r}; record the transform that joins them"
            )
        shared = set(up) & set(down)
        valid = np.ones(len(stamps_s), dtype=bool)
        sides = []
        for chain in (up, down):
            ancestor_from_frame = SE3.identity((len(stamps_s),))
            for child in (frame for frame in chain if frame not in shared):
                parent_from_child, valid_here = self._at(child, stamps_s)
                ancestor_from_frame = parent_from_child @ ancestor_from_frame
                valid &= valid_here
            sides.append(ancestor_from_frame)
        return sides[0].inverse() @ sides[1], valid

    def _edge(self, child: str) -> _Edge:
        topics = self._edges[child]
        moving = [topic for topic, edge in topics.items() if edge.moving]
        return topics[
            self._topic if self._topic in topics else (moving or [*topics])[0]
        ]

    def _refuse_ambiguous(self, child: str) -> None:
        topics = self._edges[child]
        edge = self._edge(child)
        others = [] if self._topic in topics else [*topics.values()]
        moving = sum(bool(other.moving) for other in others)
        # Equal static transforms agree, and one moving topic takes precedence over static ones.
        last = [
            np.r_[e.transforms[-1].translation, e.transforms[-1].quaternion]
            for e in others
        ]
        agree = moving == 1 or (
            not moving and all(np.allclose(last[0], x, atol=1e-6) for x in last)
        )
        parent = edge.transforms[0].parent
        if not agree or any(other.transforms[0].parent != parent for other in others):
            raise InputError(
                f"{self._source}: tf {parent} -> {child} is on several topics,"
                f" {', '.join(sorted(topics))}; choose one with --pose-topic"
            )
        if len(edge.parents) > 1:
            raise InputError(
                f"{self._source}: tf frame {child!r} has several parents,"
                f" {', '.join(sorted(edge.parents))}: two programs publish it; record with one of"
                f" them"
            )

    def _at(self, child: str, stamps_s: Array) -> tuple[SE3, BoolArray]:
        edge = self._edge(child)
        _, _, stamps, quaternions, translations = zip(*edge.transforms, strict=True)
        poses = SE3(np.array(quaternions), np.array(translations))
        if not edge.moving:
            return poses[np.zeros(len(stamps_s), int)], np.ones(
                len(stamps_s), dtype=bool
            )
        return PoseTrack(np.array(stamps), poses).at(stamps_s)

    def _chain(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in self._edges:
            parent = self._edge(chain[-1]).transforms[0].parent
            if parent in chain:
                cycle = " -> ".join([*chain, parent])
                raise InputError(f"{self._source}: tf has a cycle: {cycle}")
            chain.append(parent)
        return chain


def plain_name(frame: str) -> str:
    """Name of a frame without the leading slash of old ROS 1 programs."""
    return frame.lstrip("/")


@dataclass(frozen=True, eq=False)
class ImagePoses:
    """Poses at the images of a bag."""

    stated: RobotPoses
    """(n,) base_from_gripper, or base_from_camera."""
    valid: BoolArray
    """(n,) whether each pose was recorded close enough to the image."""
    of_camera: bool
    notes: list[str]


def poses_at_images(
    bag: BagFile, stamps_ns: IntArray, camera_frame: str, options: ReadOptions
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
    if (
        not of_camera
        and camera_frame in tree.frames()
        and tree.connected(base, camera_frame)
    ):
        notes.append(
            f"tf also has the camera ({camera_frame}), which is not used; to use it, give"
            f" --gripper-frame {camera_frame}"
        )
    return ImagePoses(RobotPoses(None, None, poses), valid, of_camera, notes)


def _tf(bag: BagFile, zero_ns: int, wanted: str | None) -> tuple[_TfTree, list[float]]:
    topics = bag.topics(*TF)
    if not topics:
        joints = bag.topics(JOINT_STATE)
        instead = f", or give the robot's --urdf for {joints[0]}" if joints else ""
        raise InputError(
            f"{bag.path}: no tf in it, so there are no gripper poses; record /tf and"
            f" /tf_static{instead}. It holds {bag.contents()}"
        )
    bag.require_topic(
        wanted, [t for t in topics if not t.endswith("tf_static")], "transforms"
    )
    tree = _TfTree(str(bag.path), wanted)
    times = []
    for message in bag.messages(topics):
        for entry in message.content.transforms:
            stamp = None
            if not message.topic.endswith("tf_static"):
                stamp = message.seconds(entry.header, zero_ns)
                times.append(stamp)
            t = entry.transform.translation
            q = entry.transform.rotation
            frames = entry.header.frame_id, entry.child_frame_id
            link = _Transform(*frames, stamp, (q.w, q.x, q.y, q.z), (t.x, t.y, t.z))
            tree.add(link, message.topic.removesuffix("_static"))
    return tree, times


def _frame(
    bag: BagFile, tree: _TfTree, wanted: str | None, usual: Sequence[str], option: str
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
        which = (
            f"it may be {' or '.join(names)}" if names else "no frame has a usual name"
        )
        raise InputError(
            f"{bag.path}: give {option} ({which}); tf has {', '.join(frames)}"
        )
    return names[0]


def _refuse_times(
    bag: BagFile, stamps: Array, times: Sequence[float], what: str
) -> NoReturn:
    covered = f"{min(times):.1f} to {max(times):.1f} s" if len(times) else "no time"
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
            f"{bag.path}: no joint states in it for --urdf {options.urdf}; it holds"
            f" {bag.contents()}"
        )
    bag.require_topic(options.pose_topic, topics, "joint states")
    tracks = _joint_tracks(bag, topics, zero_ns)
    needed = model.arm(base, gripper).joints
    values = np.zeros((len(stamps), len(tracks)))
    valid = np.ones(len(stamps), dtype=bool)
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
        values[:, column], here = interpolate(
            np.array(times), np.array(positions), stamps
        )
        valid &= here
    moved = model.poses([*tracks], values, base, gripper, bag.path)
    if not valid.any():
        _refuse_times(bag, stamps, times, "the joint states")
    return ImagePoses(poses_of_arm(moved), valid, False, moved.notes)


def _joint_tracks(
    bag: BagFile, topics: Sequence[str], zero_ns: int
) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """By joint and topic: pairs of seconds after `zero_ns` and position."""
    tracks: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for message in bag.messages(topics):
        stamp = message.seconds(message.content.header, zero_ns)
        for name, position in zip(
            message.content.name, message.content.position, strict=False
        ):
            tracks[name][message.topic].append((stamp, float(position)))
    return tracks
