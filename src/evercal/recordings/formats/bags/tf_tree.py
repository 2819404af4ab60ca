"""The tree of transforms of ROS's /tf and /tf_static."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.pose_track import PoseTrack


@dataclass
class _Edge:
    """Transforms of one child frame in its parent, from one topic."""

    parent: str
    static: bool
    stamps_s: list[float] = field(default_factory=list)
    quaternions: list[tuple[float, ...]] = field(default_factory=list)
    translations: list[tuple[float, ...]] = field(default_factory=list)

    def numbers(self) -> list[float]:
        """The last transform."""
        return [*self.translations[-1], *self.quaternions[-1]]


class TfTree:
    """Transforms of a recording, added in any order.

    Args:
        source: The recording, for messages.
        topic: Topic to use if several topics move one frame. If omitted, this is refused.
    """

    def __init__(self, source: str, topic: str | None = None) -> None:
        self._source, self._topic = source, topic
        self._edges: dict[str, dict[str, _Edge]] = {}
        """By child and topic."""
        self._parents: dict[str, set[str]] = {}
        """Parents of every child that has several on one topic."""

    def add(
        self,
        parent: str,
        child: str,
        stamp_s: float | None,
        parent_from_child: tuple[tuple[float, ...], tuple[float, ...]],
        topic: str,
    ) -> None:
        """Add one TransformStamped.

        Args:
            parent: header.frame_id.
            child: child_frame_id.
            stamp_s: Time in seconds, or None for a static transform.
            parent_from_child: Unit quaternion wxyz, and translation in metres.
            topic: Topic of the message; /tf_static belongs to /tf.
        """
        parent, child = plain_name(parent), plain_name(child)
        quaternion, translation = parent_from_child
        length = float(np.linalg.norm(quaternion))
        if not (abs(length - 1) < 1e-2 and np.isfinite(translation).all()):
            raise InputError(
                f"{self._source}: tf {parent} -> {child}: quaternion (w x y z) {quaternion},"
                f" translation {translation}: no rigid transform; repair the program that"
                f" publishes it"
            )
        topics = self._edges.setdefault(child, {})
        edge = topics.get(topic)
        if edge is not None and edge.parent != parent:
            self._parents.setdefault(child, {edge.parent}).add(parent)
            return
        # The last static transform is valid, and a moving transform takes precedence.
        if edge is None or edge.static:
            edge = topics[topic] = _Edge(parent, stamp_s is None)
        elif stamp_s is None:
            return
        edge.stamps_s.append(0.0 if stamp_s is None else stamp_s)
        edge.quaternions.append(quaternion)
        edge.translations.append(translation)

    def frames(self) -> tuple[str, ...]:
        """All frames, parents before children."""
        parents = {e.parent for topics in self._edges.values() for e in topics.values()}
        return tuple(sorted({*parents, *self._edges}, key=lambda f: (len(self._chain(f)), f)))

    def __contains__(self, frame: str) -> bool:
        """Whether a transform has this frame."""
        return frame in self.frames()

    def connected(self, a: str, b: str) -> bool:
        """Whether a chain of transforms joins two frames."""
        return self._chain(a)[-1] == self._chain(b)[-1]

    def a_from_b(
        self, a: str, b: str, stamps_s: NDArray[np.float64]
    ) -> tuple[SE3, NDArray[np.bool_]]:
        """Interpolate (n,) poses of frame b in frame a, and whether each is valid.

        Validity is that of `PoseTrack.at`.
        """
        up, down = self._chain(a), self._chain(b)
        for child in (frame for frame in (*up, *down) if frame in self._edges):
            if self._conflicting(child):
                raise InputError(
                    f"{self._source}: tf {self._edge(child).parent} -> {child} is on several"
                    f" topics, {', '.join(sorted(self._edges[child]))}; choose one with"
                    f" --pose-topic"
                )
            if child in self._parents:
                parents = ", ".join(sorted(self._parents[child]))
                raise InputError(
                    f"{self._source}: tf frame {child!r} has several parents, {parents}: two"
                    f" programs publish it; record with one of them"
                )
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
        """The transforms to use for a frame: the chosen topic, else a moving one."""
        topics = self._edges[child]
        moving = [topic for topic, edge in topics.items() if not edge.static]
        return topics[self._topic if self._topic in topics else (moving or [*topics])[0]]

    def _conflicting(self, child: str) -> bool:
        """Whether topics contradict each other about a frame and no topic was chosen."""
        edges, edge = list(self._edges[child].values()), self._edge(child)
        if self._topic in self._edges[child]:
            return False
        moving = sum(not other.static for other in edges)
        # Equal static transforms agree, and one moving topic takes precedence over static ones.
        equal = all(np.allclose(edge.numbers(), e.numbers(), atol=1e-6) for e in edges)
        agree = moving == 1 or (not moving and equal)
        return not agree or any(other.parent != edge.parent for other in edges)

    def _at(self, child: str, stamps_s: NDArray[np.float64]) -> tuple[SE3, NDArray[np.bool_]]:
        edge = self._edge(child)
        poses = SE3(np.array(edge.quaternions), np.array(edge.translations))
        if edge.static:
            return poses[np.zeros(len(stamps_s), int)], np.ones(len(stamps_s), dtype=bool)
        return PoseTrack(np.array(edge.stamps_s), poses).at(stamps_s)

    def _chain(self, frame: str) -> list[str]:
        """A frame and its ancestors up to the root."""
        chain = [frame]
        while chain[-1] in self._edges:
            parent = self._edge(chain[-1]).parent
            if parent in chain:
                cycle = " -> ".join([*chain, parent])
                raise InputError(f"{self._source}: tf has a cycle: {cycle}")
            chain.append(parent)
        return chain


def plain_name(frame: str) -> str:
    """Name of a frame without the leading slash of old ROS 1 programs."""
    return frame.lstrip("/")
