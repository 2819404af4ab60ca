"""Images of a camera while it runs.

A live camera is any object with `read()`. `StreamCamera` reads every source of `evercal track`.
"""

import threading
import time
from collections.abc import Iterator
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.recordings.streams import StreamFrame, is_live, stream

Image = NDArray[np.uint8]


class LiveCamera(Protocol):
    """A camera that states when each image was taken."""

    def read(self) -> tuple[float, Image]:
        """Take an image: time in seconds, and (H, W, 3) RGB."""
        ...


class StreamCamera:
    """The frames of a camera, a network stream, a video or a folder, one for each `read`.

    A live image arrived after the call that asks for it; it was taken earlier by the delay of the
    source. A video or a folder gives its next frame.

    Args:
        source: number or device of a camera, address, video file or folder.
        rate: frames per second of a folder whose file names hold no times.
        timeout_s: longest time to wait for a live frame, seconds.
    """

    def __init__(self, source: str, rate: float = 15.0, timeout_s: float = 5.0):
        self._source, self._timeout_s = source, timeout_s
        self._frames = stream(source, rate)
        self._newest = NewestFrame(self._frames) if is_live(source) else None

    def read(self) -> tuple[float, Image]:
        """Take the next image."""
        if self._newest is None:
            frame = next(self._frames, None)
        else:
            frame = self._newest.after(time.time(), self._timeout_s)
        if frame is None:
            raise InputError(f"{self._source}: no more frames; check the camera or give another")
        return frame.stamp_s, frame.image

    def close(self) -> None:
        """Release the source."""
        if self._newest is not None:
            self._newest.close()
        elif (close := getattr(self._frames, "close", None)) is not None:
            close()

    def __enter__(self) -> Self:
        """The camera itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the source."""
        self.close()


class NewestFrame:
    """The newest frame of a stream, read by a thread that empties the buffer of its source.

    An error of the source is raised where the frames are used.
    """

    def __init__(self, frames: Iterator[StreamFrame]):
        self._frames, self._frame = frames, None
        self._error: Exception | None = None
        self._changed, self._ended = threading.Condition(), False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def after(self, stamp_s: float, timeout_s: float) -> StreamFrame | None:
        """Return the first frame at or after a time; None if the stream ends or none arrives."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._reached(stamp_s), timeout_s)
            if self._reached(stamp_s):
                return self._frame
        if self._error is not None:
            raise self._error
        return None

    def close(self) -> None:
        """End the thread after its next frame."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join(1.0)

    def _reached(self, stamp_s: float) -> bool:
        return self._frame is not None and self._frame.stamp_s >= stamp_s

    def _run(self) -> None:
        try:
            for frame in self._frames:
                with self._changed:
                    if self._ended:
                        break
                    self._frame = frame
                    self._changed.notify_all()
        except Exception as error:  # raised where the frames are used
            self._error = error
        finally:
            if (close := getattr(self._frames, "close", None)) is not None:
                close()
            with self._changed:
                self._ended = True
                self._changed.notify_all()
