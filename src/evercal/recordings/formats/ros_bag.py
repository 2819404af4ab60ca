"""ROS 1 and ROS 2 bags and MCAP files: images, the camera's intrinsics, and the arm's poses.

    recording.bag, recording.mcap, or the folder that `ros2 bag record` wrote

Images are sensor_msgs/Image or CompressedImage of one topic, the intrinsics the camera_info beside
it (`P` of a rectified image, else `K` and `D`). base_from_gripper comes from /tf and /tf_static at
the images' stamps, interpolated, or with a URDF from /joint_states. Where the frame called gripper
is that of the images itself, the poses are base_from_camera. Images stay in the bag until needed.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.formats.bags import file as bag_file
from evercal.recordings.formats.bags import images as ros_images
from evercal.recordings.formats.bags.camera import bag_camera
from evercal.recordings.formats.bags.file import BagFile
from evercal.recordings.formats.bags.poses import Placed, place_images
from evercal.recordings.formats.bags.tf_tree import plain
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import StoredImage, image_file
from evercal.recordings.poses.camera_file import read_camera
from evercal.recordings.poses.pose_track import MAX_GAP_S
from evercal.recordings.read_options import ReadOptions

USES = ("camera", "image_topic", "pose_topic", "base_frame", "gripper_frame", "urdf")


def detect(root: Path) -> bool:
    """Whether `root` looks like a bag, file or folder."""
    return bag_file.is_bag(root)


def load(root: Path, options: ReadOptions | None = None) -> Recording:
    """Reads stamps, intrinsics and poses; decodes the first image only.

    Raises:
        InputError: The bag cannot be read, or lacks images, intrinsics or poses; the message lists
            what it holds.
    """
    root, options = Path(root), options or ReadOptions()
    bag = BagFile(root)
    topic = _image_topic(bag, options.image_topic)
    shots, notes = _shots(bag, topic)
    size = shots[0].image.read().shape[1::-1]
    if options.camera is not None:
        camera = read_camera(options.camera, (size[0], size[1]))
        _check_size(str(options.camera), camera, topic, size)
    else:
        where, camera = bag_camera(bag, topic)
        _check_size(f"{root}: {where}", camera, topic, size)
    stamps = np.array([shot.stamp_ns for shot in shots])
    placed = place_images(bag, stamps, shots[0].frame_id, options)
    frames = _frames(shots, camera, placed)
    lost = len(shots) - len(frames)
    if lost:
        notes.append(
            f"{lost} of {len(shots)} images lie outside the recorded poses or in a gap of more than"
            f" {MAX_GAP_S:g} s in which the gripper moved"
        )
    return Recording(root.resolve().stem, frames, (), lost, notes=(*notes, *placed.notes))


@dataclass(frozen=True, eq=False)
class BagImage(StoredImage):
    """One image message in a bag."""

    bag: BagFile
    topic: str
    logged_ns: int
    repeat: int

    def read(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB.

        Raises:
            InputError: It cannot be decoded.
        """
        message = self.bag.message(self.topic, self.logged_ns, self.repeat)
        decode = ros_images.image_of if message.kind == bag_file.IMAGE else _decompress
        try:
            return decode(message.content)
        except ValueError as error:
            raise InputError(f"{self.bag.path}: topic {self.topic}: {error}") from None

    def file(self) -> tuple[str, bytes] | None:
        """The JPEG or PNG of a compressed image."""
        if self.bag.kinds[self.topic] != bag_file.COMPRESSED:
            return None
        message = self.bag.message(self.topic, self.logged_ns, self.repeat)
        return image_file(bytes(message.content.data))


_decompress = ros_images.compressed_image_of


@dataclass(frozen=True, eq=False)
class _Shot:
    """One image and when it was taken."""

    image: BagImage
    stamp_ns: int
    frame_id: str


def _image_topic(bag: BagFile, wanted: str | None) -> str:
    """The topic asked for, or the only one that holds pictures."""
    topics = bag.topics(bag_file.IMAGE, bag_file.COMPRESSED)
    if wanted is not None:
        if wanted not in topics:
            raise InputError(
                f"{bag.path}: no images on topic {wanted!r}; images are on"
                f" {', '.join(topics) or 'none'}"
            )
        return wanted
    if not topics:
        raise InputError(
            f"{bag.path}: no images in it; record a topic of sensor_msgs/Image or CompressedImage."
            f" It holds {bag.contents()}"
        )
    refused = {topic: _refused(bag, topic) for topic in topics}
    pictures = [topic for topic, reason in refused.items() if reason is None]
    if len(pictures) != 1:
        reasons = "; ".join(f"{t}: {reason}" for t, reason in refused.items() if reason)
        what = f"images on {len(pictures)} topics" if pictures else f"no pictures ({reasons})"
        raise InputError(
            f"{bag.path}: {what}; name one with --image-topic: {', '.join(pictures or topics)}"
        )
    return pictures[0]


def _refused(bag: BagFile, topic: str) -> str | None:
    first = next(bag.messages([topic])).content
    if bag.kinds[topic] == bag_file.IMAGE:
        return ros_images.refused(first.encoding)
    return "holds depth" if "compressedDepth" in first.format else None


def _shots(bag: BagFile, topic: str) -> tuple[list[_Shot], list[str]]:
    """All images by the time they were taken."""
    shots = []
    for message in bag.messages([topic]):
        header = message.content.header
        stamp = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        image = BagImage(bag, topic, message.logged_ns, message.repeat)
        shots.append(_Shot(image, stamp, plain(header.frame_id)))
    notes = []
    if all(shot.stamp_ns == 0 for shot in shots):
        shots = [_Shot(s.image, s.image.logged_ns, s.frame_id) for s in shots]
        notes.append(f"images on {topic} carry no stamps; the times of recording were taken")
    return sorted(shots, key=lambda shot: shot.stamp_ns), notes


def _check_size(where: str, camera: Camera, topic: str, size: tuple[int, ...]) -> None:
    if (camera.width, camera.height) != tuple(size):
        raise InputError(
            f"{where} is for images of {camera.width}x{camera.height}, those on {topic} are"
            f" {size[0]}x{size[1]}; give their intrinsics with --camera"
        )


def _frames(shots: list[_Shot], camera: Camera, placed: Placed) -> tuple[Frame, ...]:
    frames = []
    for i, (shot, pose) in enumerate(zip(shots, placed.poses, strict=True)):
        if placed.known[i]:
            poses = (pose, None) if placed.of_camera else (None, pose)
            frames.append(Frame(f"{i:06d}", shot.image, camera, *poses))
    return tuple(frames)
