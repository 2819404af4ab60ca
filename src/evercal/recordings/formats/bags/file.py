"""ROS 1 and ROS 2 bags and MCAP files, opened by rosbags (extra `bags`) without ROS."""

import threading
import weakref
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from evercal.classes import frozen
from evercal.errors import InputError, optional_module
from evercal.recordings.images import files_in
from evercal.storage.text_files import few, library_errors

_FILES = (".bag", ".mcap", ".db3")
"""Endings of bags."""
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JOINT_STATE = "sensor_msgs/msg/JointState"
_REMEDIES = {
    "not indexed": "; repair it with 'rosbag reindex'",
    "end magic": "; its recorder did not end, restore it with 'mcap recover FILE -o NEW.mcap'",
    "Bag index looks damaged": "; repair it with 'rosbag reindex'",
    "Profile is not ros2": "; its messages are not ROS 2's, convert it or record with ros2 bag",
}
"""Remedies by words in the errors of rosbags."""
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types of transforms in ROS 2 and 1."""


@frozen
class Message:
    """One message of a bag."""

    topic: str
    logged_ns: int
    """Time of recording, nanoseconds."""
    repeat: int
    """Number of earlier messages of the topic with the same time of recording."""
    content: Any
    """Fields as rosbags decodes them."""

    @property
    def stamp_ns(self) -> int:
        """Nanoseconds of its header; 0 if they are not set."""
        return _nanoseconds(self.content.header)

    def seconds(self, header: Any, zero_ns: int) -> float:
        """Time of a header after `zero_ns`; that of recording if it is not set."""
        return ((_nanoseconds(header) or self.logged_ns) - zero_ns) * 1e-9


class BagFile:
    """A bag that stays open until nothing refers to it: a file, or a folder of a bag or its parts.

    Threads may share it, and messages may be read while others are iterated.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        need = f"{path}: reading bags needs rosbags"
        highlevel = optional_module("rosbags.highlevel", need, "bags")
        typesys = optional_module("rosbags.typesys", need, "bags")
        # Bags of ROS 2 before Iron lack type definitions; the types read here never changed.
        types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        parts = _parts(path)
        ends = {part.suffix for part in parts}
        if len(ends) > 1:
            raise InputError(
                f"{path}: holds several kinds of bags ({', '.join(ends)}); name one"
            )
        with library_errors(f"{path}: rosbags cannot read it", _REMEDIES):
            self._reader = highlevel.AnyReader(parts, default_typestore=types)
            self._reader.open()
            kinds = {}
            for link in self._reader.connections:
                if link.msgcount:
                    kinds[str(link.topic)] = str(link.msgtype)
        weakref.finalize(self, self._reader.close)
        self._lock = threading.Lock()
        self.kinds = kinds
        """Types of the topics that hold messages."""

    def topics(self, *kinds: str) -> list[str]:
        """Names of the topics of some types, sorted."""
        return sorted(topic for topic, kind in self.kinds.items() if kind in kinds)

    def require_topic(
        self, wanted: str | None, topics: Sequence[str], what: str
    ) -> None:
        """Refuse a topic that is none of `topics`, which hold `what`."""
        if wanted is not None and wanted not in topics:
            there = ", ".join(topics) or "no topic"
            raise InputError(
                f"{self.path}: no {what} on topic {wanted!r}; {what} are on {there}"
            )

    def contents(self) -> str:
        """List of the topics, for messages."""
        words = [
            f"{topic} ({kind.replace('/msg', '')})"
            for topic, kind in sorted(self.kinds.items())
        ]
        return few(words, most=30) or "nothing"

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Iterate over the messages of some topics in recorded order."""
        messages = self._messages(topics)
        while True:
            # The lock is free between two messages, so that the caller may read others.
            with self._lock:
                message = next(messages, None)
            if not message:
                return
            yield message

    def first(self, topic: str) -> Any:
        """Content of the first message of a topic that holds some."""
        for message in self.messages([topic]):
            return message.content
        raise InputError(
            f"{self.path}: damaged: {topic} has no message, although some are listed"
        )

    def message(self, topic: str, logged_ns: int, repeat: int) -> Message:
        """Read one message."""
        with self._lock:
            for message in self._messages([topic], logged_ns, logged_ns + 1):
                if message.repeat == repeat:
                    return message
        raise InputError(
            f"{self.path}: a message of {topic} is gone; load the bag again"
        )

    def _messages(
        self,
        topics: Collection[str],
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[Message]:
        links = [link for link in self._reader.connections if link.topic in topics]
        if not links:
            return
        last: dict[str, tuple[int, int]] = {}
        with library_errors(f"{self.path}: damaged", _REMEDIES):
            for link, stamp, data in self._reader.messages(links, start_ns, stop_ns):
                before, repeat = last.get(link.topic, (stamp, -1))
                repeat += 1
                if before != stamp:
                    repeat = 0
                last[link.topic] = (stamp, repeat)
                content = self._reader.deserialize(data, link.msgtype)
                yield Message(link.topic, stamp, repeat, content)


def _nanoseconds(header: Any) -> int:
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag or a folder of one."""
    return bool(_parts(path))


def _parts(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.suffix in _FILES else []
    metadata = path / "metadata.yaml"
    if metadata.is_file():
        start = metadata.read_bytes()[:1000]
        if b"rosbag2_bagfile_information" in start:
            return [path]
    return [part for part in files_in(path, _FILES) if part.is_file()]
