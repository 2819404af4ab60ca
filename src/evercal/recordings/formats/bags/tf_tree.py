"""The transforms of ROS's /tf and /tf_static, and the chain of them between two frames."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.pose_track import PoseTrack


@dataclass
class _Edge:
    """One child frame in its parent."""

    parent: str
    static: bool
    stamps_s: list[float] = field(default_factory=list)
    quaternions: list[tuple[float, ...]] = field(default_factory=list)
    translations: list[tuple[float, ...]] = field(default_factory=list)

    def same(self, other: "_Edge") -> bool:
        """Whether two static ones place the frame alike."""
        return np.allclose(
            self.translations[-1], other.translations[-1], atol=1e-6
        ) and np.allclose(self.quaternions[-1], other.quaternions[-1], atol=1e-6)


class TfTree:
    """What was said about frames, in any order.

    Args:
        where: The recording, for the messages.
        topic: That holds where several topics place one frame; None to refuse that.
    """

    def __init__(self, where: str, topic: str | None = None) -> None:
        self._where, self._topic = where, topic
        self._edges: dict[str, dict[str, _Edge]] = {}
        """By child and topic."""
        self._two_parents: dict[str, set[str]] = {}

    def add(
        self,
        parent: str,
        child: str,
        stamp_s: float | None,
        translation_m: tuple[float, ...],
        rotation_wxyz: tuple[float, ...],
        topic: str,
    ) -> None:
        """Takes one TransformStamped.

        Args:
            parent: header.frame_id.
            child: child_frame_id.
            stamp_s: when, seconds; None where it holds at all times (/tf_static).
            translation_m: x, y, z.
            rotation_wxyz: unit quaternion.
            topic: That it came on; /tf_static goes with /tf.

        Raises:
            InputError: A quaternion that is none, or numbers that are not finite.
        """
        parent, child = plain(parent), plain(child)
        length = float(np.linalg.norm(rotation_wxyz))
        if not (abs(length - 1) < 1e-2 and np.isfinite(translation_m).all()):
            raise InputError(
                f"{self._where}: tf {parent} -> {child}: quaternion (w x y z)"
                f" {tuple(rotation_wxyz)}, translation {tuple(translation_m)}: no rigid transform;"
                f" mend what publishes it"
            )
        topics = self._edges.setdefault(child, {})
        edge = topics.get(topic)
        if edge is not None and edge.parent != parent:
            self._two_parents.setdefault(child, {edge.parent}).add(parent)
            return
        if edge is None or edge.static:  # the last static one holds, and one that moves wins
            edge = topics[topic] = _Edge(parent, stamp_s is None)
        elif stamp_s is None:
            return
        edge.stamps_s.append(0.0 if stamp_s is None else stamp_s)
        edge.quaternions.append(rotation_wxyz)
        edge.translations.append(translation_m)

    def frames(self) -> tuple[str, ...]:
        """All frames, parents before children."""
        found = dict.fromkeys(e.parent for topics in self._edges.values() for e in topics.values())
        return tuple(sorted({**found, **self._edges}, key=lambda f: (len(self._chain(f)), f)))

    def __contains__(self, frame: str) -> bool:
        """Whether anything was said about a frame."""
        return frame in self.frames()

    def connected(self, a: str, b: str) -> bool:
        """Whether a chain of transforms leads from one frame to the other."""
        return self._chain(a)[-1] == self._chain(b)[-1]

    def a_from_b(
        self, a: str, b: str, stamps_s: NDArray[np.float64]
    ) -> tuple[SE3, NDArray[np.bool_]]:
        """Poses of one frame in another, interpolated.

        Args:
            a: frame.
            b: frame.
            stamps_s: (n,) seconds.

        Returns:
            (n,) a_from_b and (n,) whether each is known, see `PoseTrack.at`.

        Raises:
            InputError: A frame that is not there, no chain between them, or one with two parents.
        """
        for frame in (a, b):
            if frame not in self:
                raise InputError(
                    f"{self._where}: no frame {frame!r} in tf; it has {', '.join(self.frames())}"
                )
        up, down = self._chain(a), self._chain(b)
        self._refuse_doubt(frame for frame in (*up, *down) if frame in self._edges)
        if up[-1] != down[-1]:
            raise InputError(
                f"{self._where}: tf has no chain between {a!r} and {b!r}: one hangs on"
                f" {up[-1]!r}, the other on {down[-1]!r}; record the transform that joins them"
            )
        shared = set(up) & set(down)
        known = np.ones(len(stamps_s), dtype=bool)
        sides = []
        for chain in (up, down):
            ancestor_from_frame = SE3.identity((len(stamps_s),))
            for child in (frame for frame in chain if frame not in shared):
                parent_from_child, seen = self._at(child, stamps_s)
                ancestor_from_frame = parent_from_child @ ancestor_from_frame
                known &= seen
            sides.append(ancestor_from_frame)
        return sides[0].inverse() @ sides[1], known

    def _refuse_doubt(self, frames: Iterable[str]) -> None:
        """Raises for a frame that is placed by several topics or in several parents."""
        for child in frames:
            edge, topics = self._edge(child)
            if topics:
                raise InputError(
                    f"{self._where}: tf {edge.parent} -> {child} is on several topics,"
                    f" {', '.join(topics)}; name the one that holds with --pose-topic"
                )
            if child in self._two_parents:
                parents = ", ".join(sorted(self._two_parents[child]))
                raise InputError(
                    f"{self._where}: tf frame {child!r} has several parents, {parents}: two"
                    f" programs publish it; record with one of them"
                )

    def _edge(self, child: str) -> tuple[_Edge, list[str]]:
        """What places a frame, and the topics that contradict one another about it."""
        topics = self._edges[child]
        if self._topic in topics:
            return topics[self._topic], []
        moving = [topic for topic, edge in topics.items() if not edge.static]
        first = topics[(moving or [*topics])[0]]
        # The same place on several topics is no contradiction, nor is a moving one on one of them.
        sure = all(edge.parent == first.parent for edge in topics.values()) and (
            len(moving) == 1 or (not moving and all(first.same(edge) for edge in topics.values()))
        )
        return first, [] if sure else sorted(topics)

    def _at(self, child: str, stamps_s: NDArray[np.float64]) -> tuple[SE3, NDArray[np.bool_]]:
        edge, _ = self._edge(child)
        poses = SE3(np.array(edge.quaternions), np.array(edge.translations))
        if edge.static:
            return poses[np.zeros(len(stamps_s), int)], np.ones(len(stamps_s), dtype=bool)
        return PoseTrack(np.array(edge.stamps_s), poses).at(stamps_s)

    def _chain(self, frame: str) -> list[str]:
        """A frame and those it hangs on, up to the root."""
        chain = [frame]
        while chain[-1] in self._edges:
            parent = self._edge(chain[-1])[0].parent
            if parent in chain:
                circle = " -> ".join([*chain, parent])
                raise InputError(f"{self._where}: tf goes in a circle: {circle}")
            chain.append(parent)
        return chain


def plain(frame: str) -> str:
    """A frame's name without the leading slash of old ROS 1 programs."""
    return frame.lstrip("/")
