"""Single frames of video files, decoded on demand by PyAV (extra `lerobot`)."""

import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from evercal.bounds import require_image_size
from evercal.classes import frozen_arrays
from evercal.errors import InputError, optional_module
from evercal.recordings.images import StoredImage
from evercal.typing import Image

_MOST_OPEN = 4
"""Maximum number of open videos."""
_READ_AHEAD_S = 1.0
"""Within this time ahead, decoding frame by frame is cheaper than seeking, seconds."""


@frozen_arrays
class VideoFrame(StoredImage):
    """One frame of a video."""

    videos: "Videos"
    path: Path
    seconds: float
    """Time since the video's first frame."""

    def read(self) -> Image:
        """Decode the frame to (H, W, 3) uint8 RGB."""
        return self.videos.frame(self.path, self.seconds)


class _Open:
    def __init__(self, container: Any) -> None:
        self.container = container
        self.stream = container.streams.video[0]
        self.stream.thread_type = "AUTO"
        self.frames: Any = None
        self.last: Any = None

    def at(self, seconds: float, half: float) -> Image | None:
        """Frame within `half` seconds of a time, or None if there is none."""
        if self.last is None or not -half < seconds - self.last.time < _READ_AHEAD_S:
            start = max(0, round(seconds / self.stream.time_base))
            self.container.seek(start, stream=self.stream, backward=True)
            self.frames = self.container.decode(self.stream)
            self.last = None
        while self.last is None or self.last.time < seconds - half:
            self.last = next(self.frames, None)
            if self.last is None:
                return None
        if self.last.time > seconds + half:
            return None
        require_image_size(self.last.width, self.last.height, self.container.name)
        return self.last.to_ndarray(format="rgb24")


class Videos:
    """Cache of open videos with `fps` frames per second; threads may share it."""

    def __init__(self, fps: float) -> None:
        self._av = optional_module(
            "av", "reading videos of datasets needs PyAV", "lerobot"
        )
        self._half = 0.5 / fps
        self._open: OrderedDict[Path, _Open] = OrderedDict()
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:  # without the open videos
        return Videos, (0.5 / self._half,)

    @classmethod
    def of(cls, path: Path) -> "Videos":
        """For videos with the frame rate of a file."""
        videos = cls(1.0)
        videos.frame(path, 0.0)
        rate = videos._open[path].stream.average_rate
        return cls(float(rate))

    @property
    def step_s(self) -> float:
        """Time between two frames, seconds."""
        return 2 * self._half

    def frame(self, path: Path, seconds: float) -> Image:
        """Decode the frame at a time in seconds since the first frame to (H, W, 3) uint8 RGB."""
        with self._lock:
            try:
                if path not in self._open:
                    while len(self._open) >= _MOST_OPEN:
                        self._open.popitem(last=False)[1].container.close()
                    self._open[path] = _Open(self._av.open(str(path)))
                self._open.move_to_end(path)
                image = self._open[path].at(seconds, self._half)
            except FileNotFoundError:
                raise InputError(f"{path}: video is missing; download it too") from None
            except (self._av.FFmpegError, IndexError, OSError) as error:
                self._open.pop(path, None)
                text = " ".join(str(error).split())[:200]
                raise InputError(f"{path}: video cannot be decoded: {text}") from None
        if image is None:
            raise InputError(
                f"{path}: no frame at {seconds:.3f} s; the video is cut off"
            )
        return np.ascontiguousarray(image, dtype=np.uint8)
