"""Checks before a request is handled: token, origin, size, queue. Requests are counted, too."""

import asyncio
import hmac
import time
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse

from evercal.bounds import RequestBounds
from evercal.service.hosts import foreign

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Message, Receive, Send], Awaitable[None]]
OPEN = ("/", "/health", "/docs", "/openapi.json")
"""Paths without a token: they reveal nothing of the map."""
PAGES = "/pages/"
"""Beginning of the paths of files of the page, which need no token either."""
SECURE = {
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'unsafe-inline';"
    " style-src 'self' 'unsafe-inline'; img-src 'self' data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of every answer: its pages load nothing from elsewhere, and no page shows them."""
_HEADERS = tuple(
    (key.lower().encode(), value.encode()) for key, value in SECURE.items()
)
_METHODS = ("GET", "POST", "DELETE", "HEAD", "OPTIONS", "PUT", "PATCH")
"""Methods that are counted by name; Prometheus would store any other word that came."""


class Metrics:
    """Counters of one service, for Prometheus."""

    def __init__(self) -> None:
        self.registry = to = CollectorRegistry()
        by = ("method", "route", "status")
        self.requests = Counter("evercal_requests", "Requests.", by, registry=to)
        self.seconds = Histogram(
            "evercal_request_seconds",
            "Time from request to answer.",
            ("route",),
            registry=to,
            buckets=(0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 60),
        )
        self.answers = Counter(
            "evercal_answers", "Located images.", ("status",), registry=to
        )
        self.scenes = Gauge("evercal_scenes", "Scenes of the map.", registry=to)
        self.waiting = Gauge(
            "evercal_waiting_images", "Images in the queue.", registry=to
        )


class _Body:
    """The body of a request, which is refused with status 408 if it takes too long."""

    def __init__(self, receive: Receive, seconds: float):
        self._receive = receive
        self._latest = time.perf_counter() + seconds
        self._ended = False

    async def part(self) -> Message:
        """The next message; after the last part the end of the connection."""
        seconds = None
        if not self._ended:
            seconds = max(self._latest - time.perf_counter(), 0.0)
        try:
            message = await asyncio.wait_for(self._receive(), seconds)
        except TimeoutError:
            self._ended = True
            raise HTTPException(
                408, "the body did not arrive in time; send it again"
            ) from None
        self._ended = not message.get("more_body", False)
        return message

    async def discard(self) -> None:
        """Read the rest for at most a second.

        A connection that is closed with unread bytes is reset: the answer would be lost.
        """
        with suppress(TimeoutError, HTTPException):
            async with asyncio.timeout(1.0):
                while not self._ended:
                    await self.part()


class Guard:
    """Refuses requests before their body is read; an ASGI middleware.

    Without a token, only this machine may ask. The bodies of the requests under way are counted:
    those beyond the limits wait at the client.
    """

    def __init__(
        self, app: App, token: str | None, limits: RequestBounds, metrics: Metrics
    ):
        self._app = app
        self._limits = limits
        self._metrics = metrics
        self._token = None if token is None else token.encode()
        self._bodies: dict[object, int] = {}
        self._streams = 0

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        headers = dict(scope["headers"])
        # The server has checked that it is one.
        length = int(headers.get(b"content-length", b"0"))
        refusal = self._refusal(scope["path"], headers, length)
        if scope["type"] == "websocket":
            return await self._stream(refusal, scope, receive, send)
        app = self._app
        if refusal is not None:
            app = _refused(*refusal)
        began = time.perf_counter()
        status = 500
        seconds = self._limits.wait_s + length / self._limits.bytes_per_s
        body = _Body(receive, seconds)

        async def counted(message: Message) -> None:
            nonlocal status
            if "status" in message:
                status = message["status"]
                if status >= 400 and b"expect" not in headers:
                    await body.discard()
                headers_sent = [*message.get("headers", ()), *_HEADERS]
                message = {**message, "headers": headers_sent}
            await send(message)

        if refusal is None and length:
            self._bodies[body] = length
        try:
            await app(scope, body.part, counted)
        finally:
            self._bodies.pop(body, None)
            route = getattr(scope.get("route"), "path", "other")
            method = scope["method"]
            if method not in _METHODS:
                method = "other"
            self._metrics.requests.labels(method, route, status).inc()
            self._metrics.seconds.labels(route).observe(time.perf_counter() - began)

    async def _stream(
        self,
        refusal: tuple[int, str] | None,
        scope: Message,
        receive: Receive,
        send: Send,
    ) -> None:
        if refusal is None and self._streams >= self._limits.streams:
            refusal = 429, "too many streams"
        if refusal is not None:  # the handshake gets status 403
            return await send(
                {"type": "websocket.close", "code": 1008, "reason": refusal[1]}
            )
        self._streams += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._streams -= 1

    def _refusal(
        self, path: str, headers: dict[bytes, bytes], length: int
    ) -> tuple[int, str] | None:
        """Status and reason for refusing a request."""
        if self._token is not None and path not in OPEN and not path.startswith(PAGES):
            given = headers.get(b"authorization", b"")
            # Compared in constant time, so that its duration reveals nothing of the token.
            if not hmac.compare_digest(given, b"Bearer " + self._token):
                return 401, "send 'Authorization: Bearer TOKEN'"
        elif self._token is None:
            # Pages that a browser on this machine shows must not reach the map.
            host = headers.get(b"host", b"").decode("latin-1")
            origin = headers.get(b"origin")
            stated = None if origin is None else origin.decode("latin-1")
            if reason := foreign(host, stated, local=True):
                return 403, f"{reason}; a token is needed"
        kind = headers.get(b"content-type", b"").lower()
        # Some take very long, or break names.
        if b"charset" in kind and b"utf-8" not in kind:
            return 415, "send forms in UTF-8"
        if b"transfer-encoding" in headers:
            return 411, "bodies of unknown length are refused; send content-length"
        if length > self._limits.body_bytes:
            most = self._limits.body_bytes
            return 413, f"body of {str(length)[:20]} bytes; at most {most}"
        held_bytes = sum(self._bodies.values()) + length
        crowded = len(self._bodies) >= self._limits.requests
        if length and (crowded or held_bytes > self._limits.held_bytes):
            return 429, "too many requests wait; try again"
        return None


def _refused(status: int, reason: str) -> JSONResponse:
    headers = {"connection": "close"}
    if status == 401:
        headers["www-authenticate"] = "Bearer"
    return JSONResponse({"error": reason}, status, headers)
