"""The tree of transforms of ROS's /tf and /tf_static."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.pose_track import PoseTrack


class Transform(NamedTuple):
    """One TransformStamped, parent_from_child."""

    parent: str
    child: str
    stamp_s: float | None
    """Seconds, or None for a static transform."""
    quaternion: tuple[float, ...]
    """Unit quaternion wxyz."""
    translation: tuple[float, ...]
    """Metres."""


@dataclass
class _Edge:
    """Transforms of one child frame from one topic; moving ones take precedence."""

    moving: list[Transform] = field(default_factory=list)
    static: list[Transform] = field(default_factory=list)

    @property
    def transforms(self) -> list[Transform]:
        return self.moving or self.static[-1:]

    @property
    def parents(self) -> set[str]:
        return {transform.parent for transform in (*self.moving, *self.static)}


class TfTree:
    """Transforms of a recording, added in any order.

    `source` names it in messages. `topic` is the one to use if several topics move one frame; if
    omitted, this is refused.
    """

    def __init__(self, source: str, topic: str | None = None) -> None:
        self._source, self._topic = source, topic
        self._edges: dict[str, dict[str, _Edge]] = {}
        """By child and topic."""

    def add(self, transform: Transform, topic: str) -> None:
        """Add a transform of a topic; /tf_static belongs to /tf."""
        length = float(np.linalg.norm(transform.quaternion))
        parent, child = plain_name(transform.parent), plain_name(transform.child)
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
        parents = {p for topics in self._edges.values() for e in topics.values() for p in e.parents}
        return tuple(sorted({*parents, *self._edges}, key=lambda f: (len(self._chain(f)), f)))

    def connected(self, a: str, b: str) -> bool:
        """Whether a chain of transforms joins two frames."""
        return self._chain(a)[-1] == self._chain(b)[-1]

    def a_from_b(
        self, a: str, b: str, stamps_s: NDArray[np.float64]
    ) -> tuple[SE3, NDArray[np.bool_]]:
        """Interpolate (n,) poses of frame b in frame a, and whether each is valid."""
        up, down = self._chain(a), self._chain(b)
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
        return topics[self._topic if self._topic in topics else (moving or [*topics])[0]]

    def _refuse_ambiguous(self, child: str) -> None:
        topics, edge = self._edges[child], self._edge(child)
        others = [] if self._topic in topics else [*topics.values()]
        moving = sum(bool(other.moving) for other in others)
        # Equal static transforms agree, and one moving topic takes precedence over static ones.
        last = [np.r_[e.transforms[-1].translation, e.transforms[-1].quaternion] for e in others]
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

    def _at(self, child: str, stamps_s: NDArray[np.float64]) -> tuple[SE3, NDArray[np.bool_]]:
        edge = self._edge(child)
        _, _, stamps, quaternions, translations = zip(*edge.transforms, strict=True)
        poses = SE3(np.array(quaternions), np.array(translations))
        if not edge.moving:
            return poses[np.zeros(len(stamps_s), int)], np.ones(len(stamps_s), dtype=bool)
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
