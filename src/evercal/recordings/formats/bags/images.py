"""Pixels of ROS Image and CompressedImage messages.

ROS names a Bayer pattern by its first two pixels and OpenCV by its second row, so `bayer_rggb8` is
OpenCV's BayerBG. The package rosbags-image is not used: it ignores the padding of rows (`step`) and
truncates 16-bit values.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.recordings.images import as_rgb, decode_image

# Encoding: bytes of a channel, channels, and OpenCV's COLOR_... constant if `as_rgb` needs it.
_ENCODINGS: dict[str, tuple[int, int, str | None]] = {
    "rgb8": (1, 3, None),
    "bgr8": (1, 3, "BGR2RGB"),
    "8UC3": (1, 3, "BGR2RGB"),
    "rgba8": (1, 4, None),
    "bgra8": (1, 4, "BGRA2RGB"),
    "8UC4": (1, 4, "BGRA2RGB"),
    "mono8": (1, 1, None),
    "8UC1": (1, 1, None),
    "rgb16": (2, 3, None),
    "bgr16": (2, 3, "BGR2RGB"),
    "mono16": (2, 1, None),
    "bayer_rggb8": (1, 1, "BayerBG2RGB"),
    "bayer_bggr8": (1, 1, "BayerRG2RGB"),
    "bayer_gbrg8": (1, 1, "BayerGR2RGB"),
    "bayer_grbg8": (1, 1, "BayerGB2RGB"),
    "yuv422": (1, 2, "YUV2RGB_UYVY"),
    "uyvy": (1, 2, "YUV2RGB_UYVY"),
    "yuv422_yuy2": (1, 2, "YUV2RGB_YUY2"),
    "yuyv": (1, 2, "YUV2RGB_YUY2"),
}


def unsupported(encoding: str) -> str | None:
    """Reason why images of an encoding cannot be read, or None if they can."""
    if encoding in _ENCODINGS:
        return None
    if encoding.startswith(("16UC", "32FC", "64FC", "16SC", "32SC")):
        return f"encoding {encoding!r} holds depth or numbers, no picture; choose a colour image"
    return f"encoding {encoding!r} is not supported; use one of {', '.join(_ENCODINGS)}"


def image_of(message: Any) -> NDArray[np.uint8]:
    """Decode a sensor_msgs/Image to (H, W, 3) uint8 RGB, 16-bit values converted as by `as_rgb`."""
    import cv2

    reason = unsupported(message.encoding)
    if reason is not None:
        raise ValueError(reason)
    size, channels, conversion = _ENCODINGS[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    line = width * channels * size
    data = np.asarray(message.data, dtype=np.uint8).reshape(-1)
    if step < line or data.size < height * step or not line * height:
        raise ValueError(
            f"{width}x{height} {message.encoding} with rows of {step} bytes, but {data.size} bytes"
        )
    # Rows may be padded.
    pixels = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :line])
    if size == 2:
        pixels = pixels.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    pixels = pixels.reshape(height, width, channels)
    if conversion is not None:
        pixels = cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}"))
    return as_rgb(pixels)


def compressed_image_of(message: Any) -> NDArray[np.uint8]:
    """Decode a sensor_msgs/CompressedImage with a PNG or JPEG to (H, W, 3) uint8 RGB."""
    if "compressedDepth" in message.format:
        raise ValueError(f"format {message.format!r} holds depth, no picture")
    image = decode_image(np.asarray(message.data, dtype=np.uint8))
    if image is None:
        raise ValueError(f"format {message.format!r} is not supported or broken; use jpeg or png")
    return image
