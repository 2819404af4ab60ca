"""The intrinsics of an image topic of a bag."""

from typing import Any

import numpy as np

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.formats.bags.file import CAMERA_INFO, BagFile
from evercal.recordings.poses.camera_file import camera_from_ros


def bag_camera(bag: BagFile, image_topic: str) -> tuple[str, Camera]:
    """Read the first camera_info beside an image topic, with its topic.

    The topic of `/camera/image_raw/compressed` is `/camera/camera_info`. Rectified images
    take P without distortion, others K and D.

    Raises:
        InputError: There is no camera_info, it is uncalibrated, or its model is not supported.
    """
    topics = bag.topics(CAMERA_INFO)
    image = image_topic.removesuffix("/compressed")
    beside = f"{image.rpartition('/')[0]}/camera_info"
    if beside not in topics:
        raise InputError(
            f"{bag.path}: no camera_info for {image_topic} ({beside} is expected, there is"
            f" {' and '.join(topics) or 'none'}); record it, or give the intrinsics with --camera"
        )
    message = next(bag.messages([beside])).content
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
    return camera_from_ros({**data, **size, "roi": offsets})
