"""ROS 1 and ROS 2 bags and MCAP files with images, intrinsics and poses of the arm.

    recording.bag, recording.mcap, or the folder written by `ros2 bag record`

Images are sensor_msgs/Image or CompressedImage of one topic. Intrinsics are of the camera_info
beside it (`P` of a rectified image, else `K` and `D`). base_from_gripper is interpolated at the
image stamps from /tf and /tf_static, or from /joint_states with a URDF. If the gripper frame is the
frame of the images themselves, the poses are base_from_camera. Images stay in the bag until needed.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.cameras.camera_file import (
    camera_from_fields,
    check_size,
    read_camera_of_size,
)
from evercal.recordings.formats.bags.file import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    BagFile,
    is_bag,
)
from evercal.recordings.formats.bags.poses import poses_at_images
from evercal.recordings.formats.bags.tf_tree import plain_name
from evercal.recordings.frame import Frame, Recording, lost_images
from evercal.recordings.images import (
    ImageFile,
    StoredImage,
    as_rgb,
    decode_image,
    image_file,
    is_readable,
)
from evercal.recordings.poses.pose_track import MAX_GAP_S
from evercal.recordings.poses.row_files import by_alias
from evercal.recordings.read_options import ReadOptions
from evercal.storage.text_files import named_errors
from evercal.typing import Image, JsonObject, Size

_ENCODINGS = by_alias("""
1 3 -: rgb8
1 3 BGR2RGB: bgr8 8UC3
1 4 -: rgba8
1 4 BGRA2RGB: bgra8 8UC4
2 3 -: rgb16
2 3 BGR2RGB: bgr16
1 1 -: mono8 8UC1
2 1 -: mono16
1 1 BayerBG2RGB: bayer_rggb8
1 1 BayerRG2RGB: bayer_bggr8
1 1 BayerGR2RGB: bayer_gbrg8
1 1 BayerGB2RGB: bayer_grbg8
1 2 YUV2RGB_UYVY: yuv422 uyvy
1 2 YUV2RGB_YUY2: yuv422_yuy2 yuyv
""")
"""Bytes of a channel, number of channels, and OpenCV's COLOR_... constant if `as_rgb` needs it. ROS
names a Bayer pattern by its first two pixels and OpenCV by its second row."""


def detect(root: Path) -> bool:
    """Whether `root` is a bag file or a folder of one."""
    return is_bag(root)


def load(root: Path, options: ReadOptions) -> Recording:
    """Read stamps, intrinsics and poses; only the first image is decoded."""
    bag = BagFile(root)
    topic = _image_topic(bag, options.image_topic)
    shots, notes = _shots(bag, topic)
    height, width = shots[0].read().shape[:2]
    if options.camera:
        camera = read_camera_of_size(options.camera, (width, height), topic)
    else:
        camera = _bag_camera(bag, topic, (width, height))
    stamps = np.array([shot.stamp_ns for shot in shots])
    camera_frame = options.camera_frame or shots[0].frame_id
    poses = poses_at_images(bag, stamps, camera_frame, options)
    frames = []
    for i in np.flatnonzero(poses.valid).tolist():
        joints = poses.stated.joints_of(i)
        pose: JsonObject = {f"base_from_{poses.owner}": poses.stated.poses[i]}
        frames.append(Frame(f"{i:06d}", shots[i], camera, joints_rad=joints, **pose))
    lost = len(shots) - len(frames)
    if lost:
        notes.append(
            f"{lost} of {len(shots)} images were taken outside the recorded poses or in a gap of"
            f" more than {MAX_GAP_S:g} s in which the gripper moved"
        )
    notes += poses.notes
    stated = poses.stated
    names = stated.frames
    if camera_frame not in (names.base, names.gripper):
        names = replace(names, camera=camera_frame)
    return Recording(
        root.resolve().stem,
        tuple(frames),
        (),
        lost,
        notes=tuple(notes),
        arm=stated.arm,
        frames=names,
    )


@frozen_arrays
class BagImage(StoredImage):
    """One image message in a bag, see `Message`."""

    bag: BagFile
    topic: str
    logged_ns: int
    repeat: int
    stamp_ns: int
    frame_id: str

    def read(self) -> Image:
        """Decode the message, see `StoredImage.read`."""
        message = self._message()
        with named_errors(f"{self.bag.path}: topic {self.topic}", "image"):
            if self._is_compressed:
                return compressed_image_of(message)
            return image_of(message)

    def file(self) -> ImageFile | None:
        """JPEG or PNG of a compressed image; None for other messages."""
        if self._is_compressed:
            message = self._message()
            if "bayer" not in message.format:
                return image_file(bytes(message.data))
        return None

    @property
    def _is_compressed(self) -> bool:
        return self.bag.kinds[self.topic] == COMPRESSED

    def _message(self) -> Any:
        return self.bag.message(self.topic, self.logged_ns, self.repeat).content


def _image_topic(bag: BagFile, wanted: str | None) -> str:
    topics = bag.topics(IMAGE, COMPRESSED)
    bag.require_topic(wanted, topics, "images")
    if wanted is not None:
        return wanted
    if not topics:
        raise InputError(
            f"{bag.path}: no images in it; record a topic of sensor_msgs/Image or CompressedImage."
            f" It holds {bag.contents()}"
        )
    reasons: dict[str, str | None] = {}
    for topic in topics:
        first = bag.first(topic)
        is_plain = bag.kinds[topic] == IMAGE
        encoding = first.encoding if is_plain else _pixels_in(first.format)
        reasons[topic] = unsupported(encoding)
    pictures = [topic for topic, reason in reasons.items() if reason is None]
    if len(pictures) == 1:
        return pictures[0]
    what = f"images on {len(pictures)} topics"
    if not pictures:
        refused = "; ".join(f"{topic}: {reason}" for topic, reason in reasons.items())
        what = f"no pictures ({refused})"
    names = ", ".join(pictures or topics)
    raise InputError(f"{bag.path}: {what}; give `image_topic`: {names}")


def _shots(bag: BagFile, topic: str) -> tuple[list[BagImage], list[str]]:
    shots = []
    bad = []
    for message in bag.messages([topic]):
        content = message.content
        if bag.kinds[topic] == COMPRESSED and not is_readable(content.data):
            bad.append(len(shots))
        moment = (message.logged_ns, message.repeat, message.stamp_ns)
        frame_id = plain_name(content.header.frame_id)
        shots.append(BagImage(bag, topic, *moment, frame_id))
    notes = []
    if 0 < 2 * len(bad) <= len(shots):  # else the first one is refused with its format
        notes = [lost_images([f"message {i}" for i in bad], len(shots))]
        shots = [shot for i, shot in enumerate(shots) if i not in bad]
    if all(shot.stamp_ns == 0 for shot in shots):
        shots = [replace(shot, stamp_ns=shot.logged_ns) for shot in shots]
        notes.append(
            f"images on {topic} carry no stamps; the times of recording were taken"
        )
    return sorted(shots, key=lambda shot: shot.stamp_ns), notes


def _bag_camera(bag: BagFile, image_topic: str, size: Size) -> Camera:
    """The first camera_info beside an image topic."""
    topics = bag.topics(CAMERA_INFO)
    beside = info_topic(image_topic)
    if beside not in topics:
        raise InputError(
            f"{bag.path}: no camera_info for {image_topic} ({beside} is expected, there is"
            f" {' and '.join(topics) or 'none'}); record it, or give the intrinsics with `camera`"
        )
    return camera_info_of(f"{bag.path}: {beside}", bag.first(beside), size, image_topic)


def info_topic(image_topic: str) -> str:
    """The topic of camera_info beside images, such as `/cam/image_raw/compressed`."""
    image = image_topic.removesuffix("/compressed")
    return f"{image.rpartition('/')[0]}/camera_info"


def camera_info_of(source: str, message: Any, image_size: Size, topic: str) -> Camera:
    """Decode a sensor_msgs/CameraInfo from `source`, for images of (width, height) on a topic.

    Rectified images take P without distortion, others K and D.
    """
    image = topic.removesuffix("/compressed").rpartition("/")[2]
    with named_errors(source, "camera_info"):
        camera = _camera(message, image_size, image.startswith("image_rect"))
    check_size(source, camera, image_size, topic)
    return camera


def _camera(message: Any, image_size: Size, rectified: bool) -> Camera:
    k = _numbers(message, "k")
    if not any(k):
        raise ValueError("K is all zeros: the camera is not calibrated; give `camera`")
    d = _numbers(message, "d")
    model = message.distortion_model
    if rectified:
        p = _numbers(message, "p")
        if len(p) != 12 or not any(p):
            raise ValueError("P is missing, which rectified images need; give `camera`")
        k = np.reshape(p, (3, 4))[:, :3].ravel().tolist()
        d = []
        model = ""
    data: JsonObject = {"k": k, "d": d, "distortion_model": model}
    for name in ("width", "height", "binning_x", "binning_y"):
        data[name] = int(getattr(message, name))
    roi = message.roi
    data["roi"] = {"x_offset": int(roi.x_offset), "y_offset": int(roi.y_offset)}
    return camera_from_fields(data, image_size)


def _numbers(message: Any, name: str) -> list[float]:
    # ROS 1 writes K, D and P, ROS 2 k, d and p.
    values = getattr(message, name, getattr(message, name.upper(), []))
    return np.asarray(values).reshape(-1).tolist()


def _layout(encoding: str) -> tuple[int, int, str]:
    """A value of `_ENCODINGS`."""
    size, channels, conversion = _ENCODINGS[encoding].split()
    return int(size), int(channels), conversion


def unsupported(encoding: str) -> str | None:
    """Reason why images of an encoding cannot be read, or None if they can."""
    if encoding in _ENCODINGS:
        return None
    if encoding.startswith(("16UC", "32FC", "64FC", "16SC", "32SC")):
        return f"encoding {encoding!r} holds depth or numbers, no picture; choose a colour image"
    return f"encoding {encoding!r} is not supported; use one of {', '.join(_ENCODINGS)}"


def image_of(message: Any) -> Image:
    """Decode a sensor_msgs/Image to (H, W, 3) uint8 RGB, 16-bit values converted as by `as_rgb`."""
    reason = unsupported(message.encoding)
    if reason is not None:
        raise ValueError(reason)
    size, channels, _ = _layout(message.encoding)
    height = int(message.height)
    width = int(message.width)
    step = int(message.step)
    line = width * channels * size
    data = np.asarray(message.data, np.uint8).reshape(-1)
    if step < line or data.size < height * step or not line * height:
        raise ValueError(
            f"{width}x{height} {message.encoding}, step {step}, but {data.size} bytes"
        )
    # Rows may be padded, which the package rosbags-image ignores.
    rows = data[: height * step].reshape(height, step)
    pixels = np.ascontiguousarray(rows[:, :line])
    if size == 2:
        pixels = pixels.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    pixels = pixels.reshape(height, width, channels)
    return _rgb(pixels, message.encoding)


def _rgb(pixels: NDArray[Any], encoding: str) -> Image:
    import cv2

    _, _, conversion = _layout(encoding)
    if conversion != "-":
        pixels = cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}"))
    return as_rgb(pixels)


def compressed_image_of(message: Any) -> Image:
    """Decode a sensor_msgs/CompressedImage with a PNG or JPEG to (H, W, 3) uint8 RGB."""
    encoding = _pixels_in(message.format)
    reason = unsupported(encoding)
    if reason is not None:
        raise ValueError(f"format {message.format!r}: {reason}")
    image = decode_image(np.asarray(message.data, np.uint8))
    if image is None:
        what = f"format {message.format!r} is not supported or broken"
        raise ValueError(f"{what}; let 'image_transport republish' write jpeg or png")
    # JPEG of ROS 2 is converted without saying so.
    if encoding.startswith("bayer") and (image == image[..., :1]).all():
        return _rgb(image[..., :1], encoding)
    return image


def _pixels_in(form: str) -> str:
    """Encoding of the pixels in a compressed image; rgb8 unless it states another.

    The format is `jpeg`, or `bayer_rggb8; jpeg compressed bgr8`: the encoding before compression
    and, if the publisher converted it, the one after. Without the latter a mosaic is still one.
    """
    if "compressedDepth" in form:
        return "16UC1"
    before, _, compression = form.partition(";")
    converted = compression.partition("compressed")[2].strip()
    if converted or not compression:
        return "rgb8"
    return before.strip()
