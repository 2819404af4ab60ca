"""A topic of images as a camera, with the intrinsics beside it."""

import time

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.live.camera import StreamCamera
from evercal.live.ros2.graph import Graph
from evercal.recordings.formats.bags.file import CAMERA_INFO, COMPRESSED, IMAGE
from evercal.recordings.formats.bags.tf_tree import plain_name
from evercal.recordings.formats.ros_bag import (
    camera_info_of,
    compressed_image_of,
    image_of,
    info_topic,
)
from evercal.recordings.streams import StreamFrame
from evercal.storage.text_files import named_errors


class Ros2Camera(StreamCamera):
    """Images of a topic, raw or compressed, each with the time of its header.

    Only images that are asked for are decoded.

    Args:
        source: Address of the topic, such as `ros2:/camera/image_raw`.
        timeout_s: Seconds without an image after which its publisher is taken for gone; None
            waits for ever.
    """

    def __init__(self, source: str, timeout_s: float | None = 5.0):
        self._source = source
        self._timeout_s = timeout_s
        self._graph = Graph()
        topic = "/" + source.removeprefix("ros2:").lstrip("/")
        self._images = self._graph.find(topic, (IMAGE, COMPRESSED))

    def intrinsics(self) -> Camera:
        """Those of the camera_info beside the images; InputError without any."""
        height, width = self.read()[1].shape[:2]
        images = self._images.topic
        topic = info_topic(images)
        try:
            infos = self._graph.find(topic, (CAMERA_INFO,))
        except InputError as error:
            raise InputError(f"{error}, or give the intrinsics") from None
        message = infos.next(self._timeout_s)
        if not message:
            raise InputError(f"ros2:{topic}: nothing arrives; give the intrinsics")
        size = (width, height)
        return camera_info_of(f"ros2:{topic}", message.content, size, images)

    def close(self) -> None:
        """Nothing to release: the participant leaves with its last reader."""

    def _next(self) -> StreamFrame | None:
        message = self._images.next(self._timeout_s)
        if not message:
            return None
        content = message.content
        decode = compressed_image_of if self._images.kind == COMPRESSED else image_of
        with named_errors(self._source, "image"):
            image = decode(content)
        self.frame_id = plain_name(content.header.frame_id)
        stamp_s = message.seconds(content.header, 0)
        return StreamFrame(f"{stamp_s:.3f}", stamp_s, image, time.monotonic())
