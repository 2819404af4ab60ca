"""ROS 1 and ROS 2 bags and MCAP files with images, intrinsics and poses of the arm.

    recording.bag, recording.mcap, or the folder written by `ros2 bag record`

Images are sensor_msgs/Image or CompressedImage of one topic. Intrinsics are of the camera_info
beside it (`P` of a rectified image, else `K` and `D`). base_from_gripper is interpolated at the
image stamps from /tf and /tf_static, or from /joint_states with a URDF. If the gripper frame is the
frame of the images themselves, the poses are base_from_camera. Images stay in the bag until needed.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.formats.bags import images as ros_images
from evercal.recordings.formats.bags.file import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    BagFile,
    is_bag,
    stamp_ns,
)
from evercal.recordings.formats.bags.poses import poses_at_images
from evercal.recordings.formats.bags.tf_tree import plain_name
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import StoredImage, image_file
from evercal.recordings.poses.camera_file import camera_from_fields, check_size, read_camera_of_size
from evercal.recordings.poses.pose_track import MAX_GAP_S
from evercal.recordings.read_options import ReadOptions

USES = ("camera", "image_topic", "pose_topic", "base_frame", "gripper_frame", "urdf")


def detect(root: Path) -> bool:
    """Whether `root` is a bag file or a folder of one."""
    return is_bag(root)


def load(root: Path, options: ReadOptions | None = None) -> Recording:
    """Read stamps, intrinsics and poses; only the first image is decoded."""
    root, options = Path(root), options or ReadOptions()
    bag = BagFile(root)
    topic = _image_topic(bag, options.image_topic)
    shots, notes = _shots(bag, topic)
    height, width = shots[0].read().shape[:2]
    if options.camera is not None:
        camera = read_camera_of_size(options.camera, (width, height), topic)
    else:
        info_topic, camera = _bag_camera(bag, topic)
        check_size(f"{root}: {info_topic}", camera, (width, height), topic)
    stamps = np.array([shot.stamp_ns for shot in shots])
    poses = poses_at_images(bag, stamps, shots[0].frame_id, options)
    frames = []
    for i in np.flatnonzero(poses.valid).tolist():
        pose = poses.poses[i]
        of_camera, of_gripper = (pose, None) if poses.of_camera else (None, pose)
        frames.append(Frame(f"{i:06d}", shots[i], camera, of_camera, of_gripper))
    lost = len(shots) - len(frames)
    if lost:
        notes.append(
            f"{lost} of {len(shots)} images were taken outside the recorded poses or in a gap of"
            f" more than {MAX_GAP_S:g} s in which the gripper moved"
        )
    return Recording(root.resolve().stem, tuple(frames), (), lost, notes=(*notes, *poses.notes))


@dataclass(frozen=True, eq=False)
class BagImage(StoredImage):
    """One image message in a bag, see `Message`."""

    bag: BagFile
    topic: str
    logged_ns: int
    repeat: int
    stamp_ns: int
    frame_id: str

    def read(self) -> NDArray[np.uint8]:
        """Decode the message, see `StoredImage.read`."""
        decode = ros_images.image_of
        if self.bag.kinds[self.topic] == COMPRESSED:
            decode = ros_images.compressed_image_of
        message = self.bag.message(self.topic, self.logged_ns, self.repeat)
        try:
            return decode(message.content)
        except ValueError as error:
            raise InputError(f"{self.bag.path}: topic {self.topic}: {error}") from None

    def file(self) -> tuple[str, bytes] | None:
        """JPEG or PNG of a compressed image; None for other messages."""
        if self.bag.kinds[self.topic] != COMPRESSED:
            return None
        message = self.bag.message(self.topic, self.logged_ns, self.repeat)
        return image_file(bytes(message.content.data))


def _image_topic(bag: BagFile, wanted: str | None) -> str:
    topics = bag.topics(IMAGE, COMPRESSED)
    if wanted is not None:
        if wanted not in topics:
            raise InputError(
                f"{bag.path}: no images on topic {wanted!r}; images are on"
                f" {', '.join(topics) or 'no topic'}"
            )
        return wanted
    if not topics:
        raise InputError(
            f"{bag.path}: no images in it; record a topic of sensor_msgs/Image or CompressedImage."
            f" It holds {bag.contents()}"
        )
    reasons = {topic: _unsupported(bag, topic) for topic in topics}
    pictures = [topic for topic, reason in reasons.items() if reason is None]
    if len(pictures) != 1:
        refused = "; ".join(f"{t}: {reason}" for t, reason in reasons.items() if reason)
        what = f"images on {len(pictures)} topics" if pictures else f"no pictures ({refused})"
        raise InputError(
            f"{bag.path}: {what}; name one with --image-topic: {', '.join(pictures or topics)}"
        )
    return pictures[0]


def _unsupported(bag: BagFile, topic: str) -> str | None:
    first = bag.first(topic)
    if bag.kinds[topic] == IMAGE:
        return ros_images.unsupported(first.encoding)
    return "holds depth" if "compressedDepth" in first.format else None


def _shots(bag: BagFile, topic: str) -> tuple[list[BagImage], list[str]]:
    shots = []
    for message in bag.messages([topic]):
        header = message.content.header
        stamp, frame_id = stamp_ns(header.stamp), plain_name(header.frame_id)
        shots.append(BagImage(bag, topic, message.logged_ns, message.repeat, stamp, frame_id))
    notes = []
    if all(shot.stamp_ns == 0 for shot in shots):
        shots = [replace(shot, stamp_ns=shot.logged_ns) for shot in shots]
        notes.append(f"images on {topic} carry no stamps; the times of recording were taken")
    return sorted(shots, key=lambda shot: shot.stamp_ns), notes


def _bag_camera(bag: BagFile, image_topic: str) -> tuple[str, Camera]:
    """Read the first camera_info beside an image topic, with its topic.

    The topic of `/camera/image_raw/compressed` is `/camera/camera_info`. Rectified images
    take P without distortion, others K and D.
    """
    topics = bag.topics(CAMERA_INFO)
    image = image_topic.removesuffix("/compressed")
    beside = f"{image.rpartition('/')[0]}/camera_info"
    if beside not in topics:
        raise InputError(
            f"{bag.path}: no camera_info for {image_topic} ({beside} is expected, there is"
            f" {' and '.join(topics) or 'none'}); record it, or give the intrinsics with --camera"
        )
    message = bag.first(beside)
    try:
        return beside, _camera(message, image.rpartition("/")[2].startswith("image_rect"))
    except ValueError as error:
        raise InputError(f"{bag.path}: {beside}: {error}") from None


def _camera(message: Any, rectified: bool) -> Camera:
    # ROS 1 writes K, D and P, ROS 2 k, d and p.
    k, d, p = (
        np.asarray(getattr(message, name, getattr(message, name.upper(), []))).reshape(-1).tolist()
        for name in ("k", "d", "p")
    )
    if not any(k):
        raise ValueError("K is all zeros: the camera is not calibrated; give --camera")
    data = {"k": k, "d": d, "distortion_model": message.distortion_model}
    if rectified:
        if len(p) != 12 or not any(p):
            raise ValueError("P is missing, which rectified images need; give --camera")
        data = {"k": [*p[:3], *p[4:7], *p[8:11]], "d": [], "distortion_model": ""}
    offsets = {name: int(getattr(message.roi, name)) for name in ("x_offset", "y_offset")}
    size = {"width": int(message.width), "height": int(message.height)}
    return camera_from_fields({**data, **size, "roi": offsets})
