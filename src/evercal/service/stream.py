"""`Stream`: frames of a client, which are read at once and answered in order."""

import asyncio
import json
from collections import deque
from collections.abc import Awaitable, Callable
from typing import NamedTuple

from starlette.websockets import WebSocket, WebSocketDisconnect

from evercal.typing import JsonObject

_FULL_S = 0.02
"""Time between looks whether a full stream has become shorter, seconds."""
_FRAME_BYTES = 200
"""Memory of a frame beside its content."""


class Frame(NamedTuple):
    """A frame that a client sent."""

    number: int
    """From 0; frames that are dropped are counted."""
    data: bytes
    """An image file."""
    intrinsics: bytes
    """As `camera` of /localize; empty without any."""

    @property
    def bytes(self) -> int:
        """Memory that it takes."""
        return len(self.data) + len(self.intrinsics) + _FRAME_BYTES


class Stream:
    """The frames of one client.

    They are read while others are located: so pings are answered, and its end is noticed.

    Args:
        socket: The connection.
        most_bytes: With more frames that wait, the rest waits at the client.
        newest: Of the frames that wait, drop all but the newest.
    """

    def __init__(self, socket: WebSocket, most_bytes: int, newest: bool):
        self._socket = socket
        self._most_bytes = most_bytes
        self._newest = newest
        self._waiting = deque[Frame]()
        self._bytes = 0
        self._dropped = 0
        self._arrived = asyncio.Event()

    async def answer(self, row: Callable[[Frame], Awaitable[JsonObject]]) -> None:
        """Answer every frame with a row until the client leaves."""
        await self._socket.accept()
        reading = asyncio.create_task(self._read())
        try:
            while not reading.done():
                await self._arrived.wait()
                if self._waiting:
                    frame = self._waiting.popleft()
                    self._bytes -= frame.bytes
                    dropped = self._dropped
                    self._dropped = 0
                    answer = await row(frame)
                    counts = {"waiting": len(self._waiting), "dropped": dropped}
                    answer = {**answer, "frame": frame.number, **counts}
                    await self._socket.send_text(json.dumps(answer, allow_nan=False))
                else:
                    self._arrived.clear()
        except WebSocketDisconnect:
            pass
        finally:
            reading.cancel()

    async def _read(self) -> None:
        intrinsics = b""
        number = 0
        while (message := await self._socket.receive())["type"] == "websocket.receive":
            if message.get("text") is not None:
                intrinsics = message["text"].encode()
                continue
            if self._newest:
                self._dropped += len(self._waiting)
                self._waiting.clear()
                self._bytes = 0
            frame = Frame(number, message["bytes"], intrinsics)
            self._waiting.append(frame)
            self._bytes += frame.bytes
            self._arrived.set()
            number = number + 1
            # One read of the connection may hold thousands of small frames.
            await asyncio.sleep(0)
            while self._bytes > self._most_bytes:
                await asyncio.sleep(_FULL_S)
        self._arrived.set()
