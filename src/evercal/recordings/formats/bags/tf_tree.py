"""The tree of the transforms of tf: its frames, and the pose of one in another over time."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import NamedTuple

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.formats.bags.file import Message
from evercal.recordings.poses.pose_track import PoseTrack
from evercal.typing import Array, BoolArray, Floats, Strings

STATIC = "tf_static"
"""End of a topic whose transforms hold for all times."""
BASES = (
    "base_link",
    "base",
    "panda_link0",
    "fr3_link0",
    "fer_link0",
    "lbr_link_0",
    "link_base",
)
"""Usual names of the robot's base."""
GRIPPERS = (
    "tool0",
    "flange",
    "ee_link",
    "panda_hand",
    "fr3_hand",
    "fer_hand",
    "lbr_link_ee",
    "link_eef",
    "gripper_link",
    "tool_link",
)
"""Usual names of the gripper."""
_LENGTH_TOLERANCE = 1e-2
"""Largest deviation of the length of a quaternion from 1."""


class _Transform(NamedTuple):
    """One TransformStamped, parent_from_child."""

    parent: str
    child: str
    stamp_s: float | None
    """None if static."""
    quaternion: Floats
    """w, x, y, z."""
    translation: Floats
    """Metres."""


@dataclass
class _Edge:
    """Transforms of one child frame from one topic; moving ones take precedence."""

    moving: list[_Transform] = field(default_factory=list)
    static: list[_Transform] = field(default_factory=list)

    @property
    def transforms(self) -> list[_Transform]:
        """The moving ones, or the last static one."""
        return self.moving or self.static[-1:]

    @property
    def parent(self) -> str:
        """The frame of the first transform."""
        return self.transforms[0].parent

    @property
    def parents(self) -> set[str]:
        """The frames of all transforms."""
        return {transform.parent for transform in (*self.moving, *self.static)}


class TfTree:
    """Transforms, added in any order; `topic` is used if several topics move one frame.

    The last `most` transforms of each frame are kept.
    """

    def __init__(
        self, source: str, topic: str | None = None, most: int = sys.maxsize
    ) -> None:
        self._most = most
        self._source = source
        self._topic = topic
        self._edges: dict[str, dict[str, _Edge]] = {}  # by child and topic

    def add_message(self, message: Message, zero_ns: int) -> list[float]:
        """Add the transforms of a message; times of moving ones, seconds after `zero_ns`."""
        times = []
        for entry in message.content.transforms:
            header = entry.header
            stamp = None
            if not message.topic.endswith(STATIC):
                stamp = message.seconds(header, zero_ns)
                times.append(stamp)
            t = entry.transform.translation
            q = entry.transform.rotation
            rotation = (q.w, q.x, q.y, q.z)
            translation = (t.x, t.y, t.z)
            parent = plain_name(header.frame_id)
            child = plain_name(entry.child_frame_id)
            link = _Transform(parent, child, stamp, rotation, translation)
            self._add(link, message.topic.removesuffix("_static"))
        return times

    def frames(self) -> Strings:
        """All frames, parents before children."""
        frames = {*self._edges}
        for topics in self._edges.values():
            for edge in topics.values():
                frames |= edge.parents
        return tuple(sorted(frames, key=lambda frame: (len(self._chain(frame)), frame)))

    def frame(self, wanted: str | None, usual: Sequence[str], option: str) -> str:
        """The frame that is wanted, or the only one with a usual name; else an InputError."""
        frames = self.frames()
        if wanted:
            name = plain_name(wanted)
            if name not in frames:
                raise InputError(
                    f"{self._source}: `{option}` {wanted}: no such frame in tf; it has"
                    f" {', '.join(frames)}"
                )
            return name
        names = [name for name in usual if name in frames]
        if len(names) != 1:
            choice = "no frame has a usual name"
            if names:
                choice = f"it may be {' or '.join(names)}"
            raise InputError(
                f"{self._source}: give `{option}` ({choice}); tf has {', '.join(frames)}"
            )
        return names[0]

    def root(self, frame: str) -> str:
        """The frame above a frame that has no parent."""
        return self._chain(frame)[-1]

    def a_from_b(self, a: str, b: str, stamps_s: Array) -> tuple[SE3, BoolArray]:
        """Interpolate (n,) poses of frame b in frame a, and whether each is valid."""
        valid = np.ones(len(stamps_s), bool)
        sides = []
        for links in self._links(a, b):
            ancestor_from_frame = SE3.identity((len(stamps_s),))
            for child in links:
                parent_from_child, is_valid = self._parent_from(child, stamps_s)
                ancestor_from_frame = parent_from_child @ ancestor_from_frame
                valid &= is_valid
            sides.append(ancestor_from_frame)
        return sides[0].inverse() @ sides[1], valid

    def until(self, a: str, b: str) -> float:
        """Time of the last pose of frame b in frame a; infinite if nothing moves between them."""
        last = [np.inf]
        for child in chain(*self._links(a, b)):
            for transform in self._edge(child).moving[-1:]:
                last.append(transform.stamp_s or 0.0)
        return min(last)

    def _links(self, a: str, b: str) -> list[list[str]]:
        """The frames from a and from b up to the first that both are below, without it."""
        chains = [self._chain(a), self._chain(b)]
        for child in chain(*chains):
            if child in self._edges:
                self._refuse_ambiguous(child)
        if chains[0][-1] != chains[1][-1]:
            raise InputError(
                f"{self._source}: tf has no chain between {a!r} and {b!r}: their roots are"
                f" {chains[0][-1]!r} and {chains[1][-1]!r}; record the transform that joins them"
            )
        shared = {*chains[0]}.intersection(chains[1])
        return [[child for child in side if child not in shared] for side in chains]

    def _add(self, transform: _Transform, topic: str) -> None:
        """Add a transform of a topic; /tf_static belongs to /tf."""
        parent, child, stamp, quaternion, translation = transform
        deviation = abs(np.linalg.norm(quaternion) - 1)
        if not deviation < _LENGTH_TOLERANCE or not np.isfinite(translation).all():
            raise InputError(
                f"{self._source}: tf {parent} -> {child}: quaternion (w x y z)"
                f" {quaternion}, translation {translation}: no rigid transform;"
                f" repair the program that publishes it"
            )
        edge = self._edges.setdefault(child, {}).setdefault(topic, _Edge())
        transforms = edge.static if stamp is None else edge.moving
        transforms.append(transform)
        del transforms[: -self._most]

    def _edge(self, child: str) -> _Edge:
        topics = self._edges[child]
        if self._topic in topics:
            return topics[self._topic]
        return min(topics.values(), key=lambda edge: not edge.moving)

    def _refuse_ambiguous(self, child: str) -> None:
        topics = self._edges[child]
        edge = self._edge(child)
        if self._topic not in topics and not _agree([*topics.values()]):
            raise InputError(
                f"{self._source}: tf {edge.parent} -> {child} is on several topics,"
                f" {', '.join(sorted(topics))}; choose one with `pose_topic`"
            )
        if len(edge.parents) > 1:
            raise InputError(
                f"{self._source}: tf frame {child!r} has several parents,"
                f" {', '.join(sorted(edge.parents))}: two programs publish it; record with one of"
                f" them"
            )

    def _parent_from(self, child: str, stamps_s: Array) -> tuple[SE3, BoolArray]:
        edge = self._edge(child)
        _, _, stamps, quaternions, translations = zip(*edge.transforms, strict=True)
        poses = SE3(np.array(quaternions), np.array(translations))
        if edge.moving:
            return PoseTrack(np.array(stamps), poses).at(stamps_s)
        first = np.zeros(len(stamps_s), int)
        return poses[first], first == 0

    def _chain(self, frame: str) -> list[str]:
        frames = [frame]
        while frames[-1] in self._edges:
            parent = self._edge(frames[-1]).parent
            if parent in frames:
                cycle = " -> ".join([*frames, parent])
                raise InputError(f"{self._source}: tf has a cycle: {cycle}")
            frames.append(parent)
        return frames


def _agree(edges: Sequence[_Edge]) -> bool:
    """Equal static transforms agree, and one moving topic takes precedence over static ones."""
    if len({edge.parent for edge in edges}) > 1:
        return False
    moving = [edge for edge in edges if edge.moving]
    if moving:
        return len(moving) == 1
    numbers = []
    for edge in edges:
        last = edge.transforms[-1]
        numbers.append((*last.translation, *last.quaternion))
    return np.allclose(numbers[0], numbers, atol=1e-6)


def plain_name(frame: str) -> str:
    """Name of a frame without the leading slash of old ROS 1 programs."""
    return frame.lstrip("/")
