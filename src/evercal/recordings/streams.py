"""Frames of a stream in order: a camera, a video file, a network stream, or a folder of images."""

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evercal.bounds import require_image_size
from evercal.errors import InputError
from evercal.recordings.image_files import image_files
from evercal.recordings.images import as_rgb, read_image
from evercal.recordings.poses.row_files import times_in_names
from evercal.typing import Image

_LIVE = re.compile(r"\d+|/dev/\S+|(rtsp|rtsps|http|https|udp|tcp)://\S+|ros2:\S+")
"""Sources whose frames have the time of their arrival."""
_MOST_UNREADABLE = 30
"""A live source has ended after this many unreadable frames in a row."""


class StreamFrame(NamedTuple):
    """One frame."""

    name: str
    """File name, or number."""
    stamp_s: float
    """Seconds: in the file's name, since the start of a video, or of arrival (Unix time)."""
    image: Image
    """(H, W, 3) RGB."""
    arrived_s: float = 0.0
    """Time of arrival of a live frame by `time.monotonic`, which cannot be set back."""


def is_live(source: str) -> bool:
    """Whether a source is a camera or a network stream, not a file or folder."""
    return _LIVE.fullmatch(source) is not None


def stream(source: str, rate: float = 15.0) -> Iterator[StreamFrame]:
    """Read a source frame by frame.

    Args:
        source: Number or device of a camera, address of a network stream, video file, or folder.
        rate: Frames per second of a folder whose file names hold no times.
    """
    if not is_live(source):
        path = Path(source)
        if not path.exists():
            raise InputError(
                f"{source}: no such folder or video; give one, a camera's number (0), a device"
                " (/dev/video0) or an address (rtsp://...)"
            )
        if path.is_dir():
            return _images(path, rate)
    return _captured(source)


def _images(folder: Path, rate: float) -> Iterator[StreamFrame]:
    files = image_files([folder])
    stamps = times_in_names([path.name for path in files])
    if stamps is None:
        stamps = np.arange(len(files)) / rate
    for path, stamp in zip(files, stamps.tolist(), strict=True):
        yield StreamFrame(path.name, stamp, read_image(path))


def _captured(source: str) -> Iterator[StreamFrame]:
    import cv2

    if source.isdigit():
        capture = cv2.VideoCapture(int(source))
    else:
        capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        raise InputError(
            f"{source}: cannot be opened as a video; check path, address and codec"
        )
    width = capture.get(cv2.CAP_PROP_FRAME_WIDTH)
    height = capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
    require_image_size(int(width), int(height), source)
    return _frames_of(capture, is_live(source))


def _frames_of(capture: Any, live: bool) -> Iterator[StreamFrame]:
    import cv2

    number = 0
    unreadable = 0
    try:
        while live or not unreadable:
            good, bgr = capture.read()
            if not good:
                unreadable += 1
                if unreadable == _MOST_UNREADABLE:
                    return
                continue
            unreadable = 0
            arrived = time.monotonic()
            if live:
                stamp = time.time()
            else:
                stamp = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            image = as_rgb(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))
            yield StreamFrame(str(number), stamp, image, arrived)
            number += 1
    finally:
        capture.release()
