"""Images of a camera while it runs.

A live camera is any object with `read()`. `StreamCamera` reads every source of `evercal track`.
"""

import threading
import time
from collections.abc import Iterator
from typing import Protocol, Self

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.streams import StreamFrame, is_live, stream
from evercal.typing import Image


class LiveCamera(Protocol):
    """A camera that states when each image was taken."""

    def read(self) -> tuple[float, Image]:
        """Return an image, (H, W, 3) RGB, and the time when it was taken, seconds."""
        ...


class StreamCamera:
    """The frames of a camera, a network stream, a video or a folder, one for each `read`.

    Of a live source, `read` returns the first image that arrives after the call, never a buffered
    one. It blocks until then. Of a video or a folder it returns the next frame.

    Args:
        source: Number or device of a camera, address of a stream, video file or folder.
        rate: Frames per second of a folder whose file names hold no times.
        timeout_s: Seconds without an image after which a live source has ended; None waits as long
            as it is open.
    """

    frame_id = ""
    """Name of the optical frame, where images state it."""

    def __init__(self, source: str, rate: float = 15.0, timeout_s: float | None = 5.0):
        self._source = source
        self._timeout_s = timeout_s
        self._frames = stream(source, rate)
        self._frame: StreamFrame | None = None
        self._error: Exception | None = None
        self._changed = threading.Condition()
        self._ended = False
        self._thread: threading.Thread | None = None
        if is_live(source):  # the thread empties the buffer of the source
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()

    def read(self) -> tuple[float, Image]:
        """Return the next image with its time, seconds.

        Raises:
            InputError: The source has ended, or reading a live one failed.
        """
        for frame in self:
            return frame.stamp_s, frame.image
        raise InputError(
            f"{self._source}: no more frames; check the camera or give another"
        )

    def __iter__(self) -> Iterator[StreamFrame]:
        """The images that `read` takes, with their names, until the source ends."""
        while (frame := self._next()) is not None:
            yield frame

    def intrinsics(self) -> Camera | None:
        """Those that the source states; None if it states none."""

    def close(self) -> None:
        """Release the source, a live one after its next frame."""
        if self._thread is None:
            self._close_frames()
            return
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join(1.0)

    def __enter__(self) -> Self:
        """The camera itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the source."""
        self.close()

    def _next(self) -> StreamFrame | None:
        """The next frame, of a live source the first that arrives from now on; None at the end."""
        if self._thread is None:
            return next(self._frames, None)
        asked_s = time.monotonic()

        def arrived() -> bool:
            return self._frame is not None and self._frame.arrived_s >= asked_s

        with self._changed:
            self._changed.wait_for(lambda: self._ended or arrived(), self._timeout_s)
            if arrived():
                return self._frame
        if self._error:
            raise self._error
        return None

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
            self._close_frames()
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _close_frames(self) -> None:
        close = getattr(self._frames, "close", None)
        if close is not None:
            close()
