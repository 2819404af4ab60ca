"""An open ROS 1 or ROS 2 bag or MCAP file, read by rosbags (extra `bags`); no ROS is needed."""

import threading
import weakref
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evercal.errors import InputError

_FILES = (".bag", ".mcap", ".db3")
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, JOINT_STATE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


@dataclass(frozen=True)
class Message:
    """One message and where it stands."""

    topic: str
    """Where it was sent."""
    kind: str
    """Its type, such as sensor_msgs/msg/Image."""
    logged_ns: int
    """When it was recorded."""
    repeat: int
    """How many messages of the topic with the same time came before it."""
    content: Any
    """As rosbags decodes it."""


class BagFile:
    """A bag that is open until nothing refers to it; threads may share it.

    Args:
        path: A `.bag`, `.mcap` or `.db3` file, or a folder of a ROS 2 bag or of parts of a bag.

    Raises:
        InputError: The extra `bags` is not installed, or the bag cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise InputError(
                f"{path}: reading bags needs rosbags; run: pip install 'evercal[bags]'"
            ) from None
        # Bags of ROS 2 before Iron hold no definitions; those of the types read here never changed.
        types = get_typestore(Stores.ROS2_HUMBLE)
        try:
            self._reader = AnyReader(_parts(path), default_typestore=types)
            self._reader.open()
        except InputError:
            raise
        except Exception as error:  # damaged bags make rosbags raise many kinds
            raise InputError(f"{path}: rosbags cannot read it: {_hint(error)}") from None
        weakref.finalize(self, self._reader.close)
        self._lock = threading.Lock()
        self.kinds: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        for link in self._reader.connections:
            self.kinds[link.topic] = link.msgtype
            self.counts[link.topic] = self.counts.get(link.topic, 0) + link.msgcount

    def topics(self, *kinds: str) -> list[str]:
        """Names of the topics of some types that hold messages, sorted."""
        return sorted(t for t, kind in self.kinds.items() if kind in kinds and self.counts[t])

    def contents(self) -> str:
        """What is in it, for messages."""
        words = [f"{t} ({kind.replace('/msg', '')})" for t, kind in sorted(self.kinds.items())]
        more = f" and {len(words) - 30} more" if len(words) > 30 else ""
        return (", ".join(words[:30]) or "nothing") + more

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Message]:
        """Messages in recorded order, from `start_ns` to before `stop_ns`.

        Raises:
            InputError: Broken data.
        """
        links = [link for link in self._reader.connections if link.topic in topics]
        if not links:
            return
        last: dict[str, tuple[int, int]] = {}
        with self._lock:
            try:
                for link, stamp, data in self._reader.messages(links, start_ns, stop_ns):
                    before, repeat = last.get(link.topic, (None, -1))
                    repeat = repeat + 1 if before == stamp else 0
                    last[link.topic] = (stamp, repeat)
                    content = self._reader.deserialize(data, link.msgtype)
                    yield Message(link.topic, link.msgtype, stamp, repeat, content)
            except InputError:
                raise
            except Exception as error:  # whatever a damaged bag makes of its decoders
                raise InputError(f"{self.path}: damaged: {_hint(error)}") from None

    def message(self, topic: str, logged_ns: int, repeat: int) -> Message:
        """One message again.

        Raises:
            InputError: It is not there any more.
        """
        for found in self.messages([topic], logged_ns, logged_ns + 1):
            if found.repeat == repeat:
                return found
        raise InputError(f"{self.path}: message of {topic} at {logged_ns} ns is gone; read it anew")


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag or a folder of one."""
    if path.is_file():
        return path.suffix in _FILES
    return _is_ros2_folder(path) or bool(_bags_in(path))


def _is_ros2_folder(path: Path) -> bool:
    metadata = path / "metadata.yaml"
    try:
        return b"rosbag2_bagfile_information" in metadata.read_bytes()[:1000]
    except OSError:
        return False


def _bags_in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix in _FILES and p.is_file())


def _parts(path: Path) -> list[Path]:
    """The files to open: a ROS 2 folder as it is, else its bags, all of one kind."""
    if path.is_file() or _is_ros2_folder(path):
        return [path]
    parts = _bags_in(path)
    kinds = {part.suffix for part in parts}
    if len(kinds) > 1:
        raise InputError(f"{path}: holds bags of several kinds ({', '.join(kinds)}); name one file")
    return parts


def _hint(error: Exception) -> str:
    text = " ".join(str(error).split())[:200] or type(error).__name__
    if "not indexed" in text:
        return f"{text}; mend it with 'rosbag reindex'"
    if "Profile is not ros2" in text:
        return "its messages are not ROS 2's; convert it, or record with ros2 bag"
    return text
