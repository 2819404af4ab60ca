"""A stream of frames: they are read at once and located in order."""

import asyncio
import json
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from evercal.bounds import RequestBounds
from evercal.localization.localizer import Localizer
from evercal.localization.tracking import Tracker
from evercal.reports.answers import unit_known
from evercal.reports.track_files import track_row
from evercal.service.limits import camera_of, decoded

_FRAME_BYTES = 200
"""Memory of a frame beside its content."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Frame:
    """A frame that a client sent."""

    number: int
    """From 0; frames that are dropped are counted."""
    data: bytes
    """An image file."""
    intrinsics: bytes | None
    """As `camera` of /localize."""

    @property
    def bytes(self) -> int:
        """Memory that it needs."""
        return len(self.data) + len(self.intrinsics or b"") + _FRAME_BYTES

    @property
    def name(self) -> str:
        """Its name in answers."""
        return f"frame {self.number}"


class Waiting:
    """Frames that wait.

    Args:
        most_bytes: With more, `put` waits: the rest stays with the client.
        newest: Keep the newest frame only.
    """

    def __init__(self, most_bytes: int, newest: bool):
        self._most_bytes = most_bytes
        self._newest = newest
        self._frames: deque[Frame] = deque()
        self._bytes = 0
        self._dropped = 0
        self._ended = False
        self._changed = asyncio.Condition()

    def __len__(self) -> int:
        return len(self._frames)

    async def put(self, frame: Frame) -> None:
        """Add a frame."""
        async with self._changed:
            if self._newest:
                self._dropped += len(self._frames)
                self._clear()
            await self._changed.wait_for(lambda: self._bytes < self._most_bytes)
            self._frames.append(frame)
            self._bytes += frame.bytes
            self._changed.notify_all()

    async def take(self) -> tuple[Frame, int] | None:
        """The next frame, and the number of those dropped before it; None after the end."""
        async with self._changed:
            await self._changed.wait_for(lambda: self._frames or self._ended)
            if self._ended:
                return None
            frame = self._frames.popleft()
            self._bytes -= frame.bytes
            dropped = self._dropped
            self._dropped = 0
            self._changed.notify_all()
            return frame, dropped

    async def end(self) -> None:
        """Drop all frames: the client has left."""
        async with self._changed:
            self._clear()
            self._ended = True
            self._changed.notify_all()

    def _clear(self) -> None:
        self._frames.clear()
        self._bytes = 0


class StreamTracker:
    """Locates the frames of one stream."""

    def __init__(self, localizer: Callable[[], Localizer], limits: RequestBounds):
        self._localizer = localizer
        self._limits = limits
        self._tracker: Tracker | None = None
        self._tracked: tuple[Localizer, bytes | None] | None = None

    def row(self, frame: Frame) -> Row:
        """The row of a frame, with the state of the tracking."""
        localizer = self._localizer()
        image = decoded(frame.data, frame.name, self._limits)
        # The map or the camera changed.
        if self._tracker is None or self._tracked != (localizer, frame.intrinsics):
            camera = camera_of(frame.intrinsics, image.shape[1::-1])
            self._tracker = Tracker(localizer, camera)
            self._tracked = (localizer, frame.intrinsics)
        tracked = self._tracker.track(image, time.monotonic())
        known = unit_known(localizer, tracked.estimate.scene)
        return track_row(tracked, frame.name, known)


async def answer_frames(
    socket: WebSocket, waiting: Waiting, row: Callable[[Frame], Any]
) -> None:
    """Answer every frame with a row until the client leaves.

    Frames are read while others are located, so that a ping of the connection is answered and the
    end of the connection is noticed.
    """
    await socket.accept()
    reading = asyncio.create_task(_read(socket, waiting))
    try:
        while (taken := await waiting.take()) is not None:
            frame, dropped = taken
            content = await row(frame)
            content |= {
                "frame": frame.number,
                "waiting": len(waiting),
                "dropped": dropped,
            }
            await socket.send_text(json.dumps(content, allow_nan=False))
    except WebSocketDisconnect:
        pass
    finally:
        reading.cancel()
        with suppress(asyncio.CancelledError):
            await reading


async def _read(socket: WebSocket, waiting: Waiting) -> None:
    intrinsics = None
    number = 0
    while (message := await socket.receive())["type"] != "websocket.disconnect":
        if message.get("text") is not None:
            intrinsics = message["text"].encode()
            continue
        await waiting.put(Frame(number, message["bytes"], intrinsics))
        number = number + 1
        await asyncio.sleep(0)  # one read holds thousands of small frames
    await waiting.end()
