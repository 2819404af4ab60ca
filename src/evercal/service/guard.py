"""Checks before a request is handled: token, origin, size, queue. Requests are counted, too."""

import asyncio
import hmac
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from contextlib import suppress
from time import perf_counter
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
CROWDED = "too many requests wait; try again"
"""Of a request that is refused with status 429."""
STOPPED = "the service is being stopped; ask again"
"""Of a request that is refused with status 503."""
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
    """The body of a request, as far as it has arrived.

    It is refused with status 408 if no part of it arrives for a while, or if all of it is too slow,
    and with status 429 if the bodies that have arrived would take too much memory.
    """

    def __init__(self, receive: Receive, limits: RequestBounds, bodies: "set[_Body]"):
        self.arrived = 0
        self.ended = False
        self._receive = receive
        self._limits = limits
        self._bodies = bodies
        self._began = perf_counter()

    async def part(self) -> Message:
        """The next message; after the last part the end of the connection."""
        seconds = None
        if not self.ended:
            limits = self._limits
            passed = perf_counter() - self._began
            allowed = limits.wait_s + self.arrived / limits.bytes_per_s
            seconds = min(limits.wait_s, max(allowed - passed, 0.0))
        try:
            message = await asyncio.wait_for(self._receive(), seconds)
        except TimeoutError:
            self.ended = True
            raise HTTPException(
                408, "the body did not arrive in time; send it again"
            ) from None
        self._count(message)
        crowded = held_bytes(self._bodies) > self._limits.held_bytes
        if crowded and message.get("body"):
            raise HTTPException(429, CROWDED)
        return message

    async def discard(self) -> None:
        """Read the rest for at most a second.

        A connection that is closed with unread bytes is reset: the answer would be lost.
        """
        self._bodies.discard(self)
        with suppress(TimeoutError):
            async with asyncio.timeout(1.0):
                while not self.ended:
                    self._count(await self._receive())

    def _count(self, message: Message) -> None:
        self.arrived += len(message.get("body", b""))
        self.ended = not message.get("more_body", False)


def held_bytes(bodies: Iterable[_Body]) -> int:
    """Bytes of bodies that have arrived."""
    return sum(body.arrived for body in bodies)


class Guard:
    """Refuses requests before their body is read; an ASGI middleware.

    Without a token, only this machine may ask. What has arrived of the bodies is counted: a request
    beyond the limits is refused, and a client that stops half way holds nobody else.
    """

    def __init__(
        self, app: App, token: str | None, limits: RequestBounds, metrics: Metrics
    ):
        self._app = app
        self._limits = limits
        self._metrics = metrics
        self._token = None if token is None else token.encode()
        self._bodies: set[_Body] = set()
        self._streams = 0

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        headers = dict(scope["headers"])
        # The server has checked that it is one.
        length = int(headers.get(b"content-length", b"0"))
        refusal = self._refusal(scope, headers, length)
        if scope["type"] == "websocket":
            return await self._stream(refusal, scope, receive, send)
        app = self._app
        if refusal:
            app = _refused(*refusal)
        began = perf_counter()
        status = 0
        body = _Body(receive, self._limits, self._bodies)

        async def counted(message: Message) -> None:
            nonlocal status
            if "status" in message:
                status = message["status"]
                if status >= 400 and b"expect" not in headers:
                    await body.discard()
                headers_sent = [*message.get("headers", ()), *_HEADERS]
                message = {**message, "headers": headers_sent}
            await send(message)

        if not refusal and length:
            self._bodies.add(body)
        try:
            await app(scope, body.part, counted)
        except asyncio.CancelledError:
            # The server has been stopped, and its patience is over.
            if status:
                raise
            await _refused(503, STOPPED)(scope, body.part, counted)
        finally:
            self._bodies.discard(body)
            route = getattr(scope.get("route"), "path", "other")
            method = scope["method"]
            if method not in _METHODS:
                method = "other"
            self._metrics.requests.labels(method, route, status or 500).inc()
            self._metrics.seconds.labels(route).observe(perf_counter() - began)

    async def _stream(
        self,
        refusal: tuple[int, str] | None,
        scope: Message,
        receive: Receive,
        send: Send,
    ) -> None:
        if not refusal and self._streams >= self._limits.streams:
            refusal = 429, "too many streams"
        if refusal:  # the handshake gets status 403
            return await send(
                {"type": "websocket.close", "code": 1008, "reason": refusal[1]}
            )
        self._streams += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._streams -= 1

    def _refusal(
        self, scope: Message, headers: dict[bytes, bytes], length: int
    ) -> tuple[int, str] | None:
        """Status and reason for refusing a request."""
        path = scope["path"]
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
        parts = [scope.get("raw_path") or b"", scope["query_string"]]
        for pair in scope["headers"]:
            parts += pair
        size = sum(map(len, parts))
        if size > self._limits.header_bytes:
            most = self._limits.header_bytes
            return 431, f"headers and path of {size} bytes; at most {most}"
        kind = headers.get(b"content-type", b"").lower()
        # Some take very long, or break names.
        if b"charset" in kind and b"utf-8" not in kind:
            return 415, "send forms in UTF-8"
        if b"transfer-encoding" in headers:
            return 411, "bodies of unknown length are refused; send content-length"
        if length > self._limits.body_bytes:
            most = self._limits.body_bytes
            return 413, f"body of {str(length)[:20]} bytes; at most {most}"
        held = held_bytes(self._bodies) + length
        waiting = sum(body.ended for body in self._bodies)
        crowded = waiting >= self._limits.requests or held > self._limits.held_bytes
        if length and crowded:
            return 429, CROWDED
        return None


def _refused(status: int, reason: str) -> JSONResponse:
    headers = {"connection": "close"}
    if status == 401:
        headers["www-authenticate"] = "Bearer"
    return JSONResponse({"error": reason}, status, headers)
