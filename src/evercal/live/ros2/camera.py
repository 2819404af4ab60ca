"""A topic of images as a camera, with the intrinsics beside it."""

import time

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.live.camera import StreamCamera
from evercal.live.ros2.graph import PREFIX, Graph
from evercal.recordings.cameras.camera_file import check_size
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
        topic = "/" + source.removeprefix(PREFIX).lstrip("/")
        self._images = self._graph.subscribe(topic, (IMAGE, COMPRESSED))
        self._number = 0
        self._size: tuple[int, int] | None = None

    def intrinsics(self) -> Camera:
        """Those of the camera_info beside the images; InputError without any."""
        if self._size is None:
            self.read()
        size = self._size or (0, 0)
        topic = info_topic(self._images.topic)
        infos = self._graph.subscribe(topic, (CAMERA_INFO,))
        message = infos.next(self._timeout_s)
        if message is None:
            raise InputError(f"{PREFIX}{topic}: nothing arrives; give the intrinsics")
        with named_errors(PREFIX + topic, "camera_info"):
            camera = camera_info_of(message.content, size, self._images.topic)
        check_size(PREFIX + topic, camera, size, self._source)
        return camera

    def close(self) -> None:
        """Nothing to release: the participant leaves with its last reader."""

    def _next(self) -> StreamFrame | None:
        message = self._images.next(self._timeout_s)
        if message is None:
            return None
        decode = image_of
        if self._images.kind == COMPRESSED:
            decode = compressed_image_of
        with named_errors(self._source, "image"):
            image = decode(message.content)
        self.frame_id = plain_name(message.content.header.frame_id)
        self._size = (image.shape[1], image.shape[0])
        self._number += 1
        stamp_s = message.seconds(message.content.header, 0)
        return StreamFrame(str(self._number - 1), stamp_s, image, time.monotonic())
