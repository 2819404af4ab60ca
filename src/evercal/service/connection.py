"""Connections of the service: bounded in number, and in the time until they ask something."""

import asyncio
import socket
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from evercal.bounds import RequestBounds

_UNREAD_BYTES = 100_000
"""Of a stream, in the buffer of its socket."""


def protocols(
    limits: RequestBounds,
) -> tuple[type[H11Protocol], type[WebSocketsSansIOProtocol]]:
    """The protocols of a service with limits: of requests, and of streams."""

    class BoundedConnection(_Connection):
        bounds = limits

    class BoundedStream(_Stream):
        bounds = limits

    return BoundedConnection, BoundedStream


class _Patient:
    """Closes a connection whose answers are not read in time."""

    bounds: RequestBounds
    loop: asyncio.AbstractEventLoop
    transport: Any
    unread: asyncio.TimerHandle | None = None

    def pause_writing(self) -> None:
        super().pause_writing()  # pyright: ignore[reportAttributeAccessIssue]
        self.unread = self.loop.call_later(self.bounds.wait_s, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()  # pyright: ignore[reportAttributeAccessIssue]
        if self.unread:
            self.unread.cancel()


class _Stream(_Patient, WebSocketsSansIOProtocol):
    """A stream that is closed if its handshake takes too long, or if its client is silent.

    The answer to a ping comes after all frames that were sent before it.
    """

    received_s: float = 0.0
    """When the client was heard last."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.loop.call_later(self.bounds.wait_s, self._late)
        # Pings of a client that sends too much wait behind what is in there.
        own = transport.get_extra_info("socket")
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _UNREAD_BYTES)

    def data_received(self, data: bytes) -> None:
        self.received_s = self.loop.time()
        super().data_received(data)

    def keepalive_timeout(self) -> None:
        if self.read_paused or self.received_s > self.ping_sent_at:
            self.stop_keepalive()
            self.start_keepalive()
        else:
            super().keepalive_timeout()

    def _late(self) -> None:
        if not self.handshake_complete:
            self.transport.abort()


class _Connection(_Patient, H11Protocol):
    """A connection that is closed if a header takes too long."""

    latest: asyncio.TimerHandle | None = None
    """Closes the connection unless a request is under way by then."""

    @property
    def waits(self) -> bool:
        """Whether no request is under way."""
        return self.cycle is None or self.cycle.response_complete

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._wait()
        if len(self.connections) <= self.bounds.connections:
            return
        ours = [c for c in self.connections if isinstance(c, _Connection)]
        oldest = min((c for c in ours if c.waits), key=_Connection._deadline)
        oldest.transport.abort()  # at worst this one

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._wait()

    def handle_websocket_upgrade(self, event: Any) -> None:
        self._stop_waiting()
        super().handle_websocket_upgrade(event)

    def _deadline(self) -> float:
        if not self.latest:
            return 0.0
        return self.latest.when()

    def _wait(self) -> None:
        self._stop_waiting()
        self.latest = self.loop.call_later(self.bounds.wait_s, self._late)

    def _stop_waiting(self) -> None:
        if self.latest:
            self.latest.cancel()

    def _late(self) -> None:
        if self.waits:
            self.transport.abort()
