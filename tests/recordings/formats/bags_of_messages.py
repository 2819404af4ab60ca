"""Small bags with a turning arm in them, written by rosbags in every container that ROS has."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings import ReadOptions, load_recording

KINDS = ("ros1", "sqlite3", "mcap")
START_NS = 1_700_000_000_123_456_789
WIDTH = 32
HEIGHT = 24
# Not at the times of the transforms; the last two are after the last pose of the arm.
SHOTS = (0.0, 0.013, 0.5, 0.987, 1.711, 2.0, 2.05, 2.5)
BASE_FROM_SHOULDER = SE3.exp([0.1, 0.2, 0.3, 0.0, 0.0, 0.5])
TOOL_FROM_OPTICAL = SE3.exp([0.02, -0.05, 0.03, 0.3, -0.2, 1.2])


def shoulder_from_tool(seconds: float) -> SE3:
    """Turns about a slanted axis and moves on a line, both steadily."""
    rotation = Rotation.from_rotvec(np.array([0.6, -0.3, 0.8]) * seconds)
    return SE3.of(rotation, np.array([0.4, 0.1, 0.5]) + 0.2 * seconds)


def picture(number: int) -> np.ndarray:
    """A picture that differs by number, with distinct red, green and blue."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, : WIDTH // 2] = (200, 100, 10 + number)
    image[HEIGHT // 2 :, WIDTH // 2 :] = (20, 220, 60)
    return image


@dataclass
class Bag:
    """Messages to write, as (topic, type, time in ns, message)."""

    kind: str
    messages: list[tuple[str, str, int, Any]] = field(default_factory=list)
    optical: str = "camera_optical"

    def __post_init__(self) -> None:
        self.store = get_typestore(Stores.LATEST)
        if self.kind == "ros1":  # rosbags has the common messages only
            self.store = get_typestore(Stores.ROS1_NOETIC)
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))

    def make(self, what: str, **fields: Any) -> Any:
        """A message; the sequence number of ROS 1 headers is filled in."""
        if what == "std_msgs/msg/Header" and self.kind == "ros1":
            fields["seq"] = 0
        return self.store.types[what](**fields)

    def header(self, seconds: float | None, frame: str) -> Any:
        """Stamped at the bag's start and some seconds, or with zero."""
        ns = 0 if seconds is None else START_NS + round(seconds * 1e9)
        stamp = self.make(
            "builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9
        )
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def add(self, topic: str, kind: str, seconds: float, **fields: Any) -> None:
        """A message that is recorded 5 ms after `seconds`."""
        logged = START_NS + round(seconds * 1e9) + 5_000_000
        self.messages.append((topic, kind, logged, self.make(kind, **fields)))

    def tf(self, seconds: float, parent: str, child: str, pose: SE3, static: bool = False,
           robot: str = "") -> None:  # fmt: skip
        """One transform; static ones carry a stamp too, which means nothing."""
        w, x, y, z = pose.rotation_wxyz.tolist()
        tx, ty, tz = pose.translation_m.tolist()
        transform = self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", x=tx, y=ty, z=tz),
            rotation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )
        entry = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(seconds, parent),
            child_frame_id=child,
            transform=transform,
        )
        topic = robot + ("/tf_static" if static else "/tf")
        self.add(topic, "tf2_msgs/msg/TFMessage", seconds, transforms=[entry])

    def image(self, seconds: float, topic: str, pixels: np.ndarray, encoding: str = "rgb8",
              stamped: bool = True) -> None:  # fmt: skip
        """Rows of bytes, padded."""
        height, width = pixels.shape[:2]
        rows = pixels.reshape(height, -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, 3)), constant_values=99)
        self.add(
            topic,
            "sensor_msgs/msg/Image",
            seconds,
            header=self.header(seconds if stamped else None, self.optical),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.reshape(-1),
        )

    def compressed(self, seconds: float, topic: str, data: bytes, what: str) -> None:
        """An image file."""
        head = self.header(seconds, self.optical)
        content = np.frombuffer(data, np.uint8)
        kind = "sensor_msgs/msg/CompressedImage"
        self.add(topic, kind, seconds, header=head, format=what, data=content)

    def info(self, topic: str = "/cam/camera_info", focal: float = 30.0, model: str = "plumb_bob",
             size: tuple[int, int] = (WIDTH, HEIGHT), binning: int = 0) -> None:  # fmt: skip
        """A camera_info."""
        k = [focal, 0, 15.0, 0, focal, 11.0, 0, 0, 1] if focal else [0.0] * 9
        p = [28.0, 0, 16.0, 0, 0, 28.0, 12.0, 0, 0, 0, 1, 0]
        values = {"k": k, "d": [0.1, 0, 0, 0, 0], "r": np.eye(3).reshape(-1), "p": p}
        if self.kind == "ros1":
            values = {name.upper(): value for name, value in values.items()}
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0,
                        width=0, do_rectify=False)  # fmt: skip
        self.add(
            topic,
            "sensor_msgs/msg/CameraInfo",
            0.0,
            header=self.header(0.0, self.optical),
            width=size[0],
            height=size[1],
            distortion_model=model,
            binning_x=binning,
            binning_y=binning,
            roi=roi,
            **{name: np.array(value, np.float64) for name, value in values.items()},
        )

    def joints(self, seconds: float, values: dict[str, float],
               topic: str = "/joint_states") -> None:  # fmt: skip
        """A joint state."""
        numbers = np.array(list(values.values()))
        none = np.empty(0)
        self.add(topic, "sensor_msgs/msg/JointState", seconds, header=self.header(seconds, ""),
                 name=list(values), position=numbers, velocity=none, effort=none)  # fmt: skip

    def write(self, root: Path) -> Path:
        """Writes all messages by time; gives the path of the bag."""
        root.mkdir(exist_ok=True)
        ordered = sorted(self.messages, key=lambda entry: entry[2])
        encode = self.store.serialize_cdr
        path = root / "wave"
        writing: Any
        if self.kind == "ros1":
            encode = self.store.serialize_ros1
            path = root / "wave.bag"
            writing = Writer1(path)
        else:
            plugin = StoragePlugin[self.kind.upper()]
            writing = Writer2(path, version=9, storage_plugin=plugin)
        links: dict[tuple[str, str], Any] = {}
        with writing as writer:
            for topic, kind, ns, message in ordered:
                if (topic, kind) not in links:
                    link = writer.add_connection(topic, kind, typestore=self.store)
                    links[topic, kind] = link
                writer.write(links[topic, kind], ns, encode(message, kind))
        return path


WORLD_FROM_BASE = SE3.exp([9.0, 9.0, 9.0, 1.0, 0.0, 0.0])


def arm(kind: str = "mcap", **info: Any) -> Bag:
    """tf of an arm: world and stand and camera are static, the tool moves. One camera_info."""
    bag = Bag(kind)
    bag.tf(0.0, "world", "base_link", WORLD_FROM_BASE, static=True)
    bag.tf(0.0, "base_link", "shoulder", BASE_FROM_SHOULDER, static=True)
    bag.tf(0.0, "tool0", "camera_optical", TOOL_FROM_OPTICAL, static=True)
    for i in range(51):
        bag.tf(i / 25, "shoulder", "tool0", shoulder_from_tool(i / 25))
    bag.info(**info)
    return bag


def single(
    pixels: np.ndarray | None = None, encoding: str = "rgb8", topic: str = "/cam/image_raw",
    kind: str = "mcap", at: float = 0.5, stamped: bool = True, **info: Any,
) -> Bag:  # fmt: skip
    """An arm, a camera and one image."""
    bag = arm(kind, **info)
    bag.image(at, topic, picture(0) if pixels is None else pixels, encoding, stamped)
    return bag


def recorded_bag(kind: str = "mcap") -> Bag:
    """An arm, a camera and its images."""
    bag = arm(kind)
    for i, at in enumerate(SHOTS):
        bag.image(at, "/cam/image_raw", picture(i))
    return bag


def refusal(bag: Bag, root: Path, **options: object) -> str:
    """Why a bag cannot be read, in one line that names it."""
    return refusal_of(bag.write(root), **options)


def refusal_of(path: Path, **options: object) -> str:
    """Why a written bag cannot be read, in one line that names it."""
    with pytest.raises(InputError) as caught:
        load_recording(path, options=ReadOptions(**options))  # pyright: ignore[reportArgumentType]
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    return message
