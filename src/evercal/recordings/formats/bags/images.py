"""Pixels of ROS's Image and CompressedImage messages.

Bayer patterns are named by their first two pixels in ROS and by the second row in OpenCV, so that
`bayer_rggb8` is OpenCV's BayerBG.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.recordings.images import decode_image

# Encoding: bytes of a channel, channels, OpenCV's constant COLOR_... that makes it RGB.
_ENCODINGS: dict[str, tuple[int, int, str | None]] = {
    "rgb8": (1, 3, None),
    "bgr8": (1, 3, "BGR2RGB"),
    "8UC3": (1, 3, "BGR2RGB"),
    "rgba8": (1, 4, "RGBA2RGB"),
    "bgra8": (1, 4, "BGRA2RGB"),
    "8UC4": (1, 4, "BGRA2RGB"),
    "mono8": (1, 1, "GRAY2RGB"),
    "8UC1": (1, 1, "GRAY2RGB"),
    "rgb16": (2, 3, None),
    "bgr16": (2, 3, "BGR2RGB"),
    "mono16": (2, 1, "GRAY2RGB"),
    "bayer_rggb8": (1, 1, "BayerBG2RGB"),
    "bayer_bggr8": (1, 1, "BayerRG2RGB"),
    "bayer_gbrg8": (1, 1, "BayerGR2RGB"),
    "bayer_grbg8": (1, 1, "BayerGB2RGB"),
    "yuv422": (1, 2, "YUV2RGB_UYVY"),
    "uyvy": (1, 2, "YUV2RGB_UYVY"),
    "yuv422_yuy2": (1, 2, "YUV2RGB_YUY2"),
    "yuyv": (1, 2, "YUV2RGB_YUY2"),
}


def refused(encoding: str) -> str | None:
    """Why an encoding of Image messages cannot be read; None if it can."""
    if encoding in _ENCODINGS:
        return None
    if encoding.startswith(("16UC", "32FC", "64FC", "16SC", "32SC")):
        return f"encoding {encoding!r} holds depth or numbers, no picture; choose a colour image"
    return f"encoding {encoding!r} is not supported; use one of {', '.join(_ENCODINGS)}"


def image_of(message: Any) -> NDArray[np.uint8]:
    """The picture in a sensor_msgs/Image.

    Sixteen bits become eight by division, as cv_bridge does it.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        ValueError: An encoding that cannot be read, or less data than its size needs.
    """
    import cv2

    reason = refused(message.encoding)
    if reason is not None:
        raise ValueError(reason)
    size, channels, colour = _ENCODINGS[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    line = width * channels * size
    data = np.asarray(message.data, dtype=np.uint8).reshape(-1)
    if step < line or data.size < height * step or not line:
        raise ValueError(
            f"{width}x{height} {message.encoding} with rows of {step} bytes, but {data.size} bytes"
        )
    # Rows may be padded.
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :line])
    if size == 2:
        rows = rows.view(">u2" if message.is_bigendian else "<u2")
        rows = (rows.astype(np.float64) / 257).round().astype(np.uint8)
    pixels = rows.reshape(height, width, channels) if channels > 1 else rows
    if colour is not None:
        pixels = cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{colour}"))
    return np.ascontiguousarray(pixels, dtype=np.uint8)


def compressed_image_of(message: Any) -> NDArray[np.uint8]:
    """The picture in a sensor_msgs/CompressedImage with a PNG or JPEG in it.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        ValueError: Another format, a depth image, or broken data.
    """
    data = np.asarray(message.data, dtype=np.uint8)
    if "compressedDepth" in message.format:
        raise ValueError(f"format {message.format!r} holds depth, no picture")
    image = decode_image(data)
    if image is None:
        raise ValueError(f"format {message.format!r} is not supported or broken; use jpeg or png")
    return image
