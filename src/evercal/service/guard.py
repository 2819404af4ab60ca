"""Checks before a request is read: token, origin, size of the body. And what is counted of it."""

import asyncio
import contextlib
import hmac
import json
import time
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import urlsplit

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from starlette.exceptions import HTTPException

from evercal.service.limits import Limits

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[MutableMapping[str, Any], Receive, Send], Awaitable[None]]
OPEN = ("/health", "/docs", "/openapi.json")
"""Paths without a token: they hold nothing of the map."""
_DRAIN_S = 1.0
_HEADER_BYTES = 32 * 1024
_LOCAL = ("localhost", "127.0.0.1", "::1")


class Metrics:
    """Counters of one service, for Prometheus."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "evercal_requests",
            "Requests by route and status.",
            ("method", "route", "status"),
            registry=self.registry,
        )
        self.seconds = Histogram(
            "evercal_request_seconds",
            "Time from request to answer.",
            ("route",),
            registry=self.registry,
            buckets=(0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 60),
        )
        self.answers = Counter(
            "evercal_answers",
            "Images by status of the answer.",
            ("status",),
            registry=self.registry,
        )
        self.gauges = {
            name: Gauge(f"evercal_{name}", text, registry=self.registry)
            for name, text in (
                ("scenes", "Scenes of the map."),
                ("waiting_images", "Images that wait or are being located."),
                ("pending_jobs", "Recordings that wait or are being learned."),
            )
        }


class Guard:
    """Refuses requests before their body is read; an ASGI middleware.

    Args:
        app: The service.
        token: Requests must have it as bearer token. Without one, only this machine may ask.
        limits: Sizes of bodies.
        metrics: Counters.
    """

    def __init__(self, app: App, token: str | None, limits: Limits, metrics: Metrics):
        self._app, self._limits, self._metrics = app, limits, metrics
        self._token = None if token is None else token.encode()

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        headers = dict(scope["headers"])
        refusal = self._refusal(scope["path"], headers) or self._too_long(scope, headers)
        if scope["type"] == "websocket":
            if refusal is not None:  # the handshake gets status 403
                return await send({"type": "websocket.close", "code": 1008, "reason": refusal[1]})
            return await self._app(scope, receive, send)
        began, status = time.perf_counter(), [500]
        body = _Body(receive, self._most(scope))

        async def counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                status[0] = message["status"]
                if status[0] >= 400 and b"expect" not in headers:
                    await body.drain()
            await send(message)

        try:
            if refusal is not None:
                await _refuse(counted, *refusal)
            else:
                await self._app(scope, body.read, counted)
        finally:
            route = getattr(scope.get("route"), "path", "other")
            self._metrics.requests.labels(_method(scope), route, status[0]).inc()
            self._metrics.seconds.labels(route).observe(time.perf_counter() - began)

    def _refusal(self, path: str, headers: dict[bytes, bytes]) -> tuple[int, str] | None:
        """Status and reason for refusing a request."""
        if self._token is not None:
            given = headers.get(b"authorization", b"")
            # Compared in constant time, so that its duration reveals nothing of the token.
            same = hmac.compare_digest(given, b"Bearer " + self._token)
            return None if same or path in OPEN else (401, "send 'Authorization: Bearer TOKEN'")
        # Without a token, pages that a browser on this machine shows must not reach the map.
        host = headers.get(b"host", b"").decode("latin-1")
        if _hostname(host) not in _LOCAL:
            return 403, f"host {host[:100]!r} is not this machine; a token is needed"
        origin = headers.get(b"origin")
        if origin is not None and origin.decode("latin-1").partition("://")[2] != host:
            return 403, "requests of other web pages are refused; a token is needed"
        return None

    def _most(self, scope: MutableMapping[str, Any]) -> int:
        recording = scope["path"] == "/scenes"
        return self._limits.archive_bytes if recording else self._limits.body_bytes

    def _too_long(
        self, scope: MutableMapping[str, Any], headers: dict[bytes, bytes]
    ) -> tuple[int, str] | None:
        size = sum(len(name) + len(value) for name, value in scope["headers"])
        if size + len(scope.get("raw_path") or b"") + len(scope["query_string"]) > _HEADER_BYTES:
            return 431, f"headers and path of more than {_HEADER_BYTES} bytes"
        length = headers.get(b"content-length", b"0")
        if not length.isdigit():
            return 400, "content-length is not a number"
        most = self._most(scope)
        return (
            None if int(length) <= most else (413, f"body of {int(length)} bytes; at most {most}")
        )


class _Body:
    """The body of a request, counted while it arrives."""

    def __init__(self, receive: Receive, most: int):
        self._receive, self._most, self._total, self._ended = receive, most, 0, False

    async def read(self) -> Message:
        """The next part.

        Raises:
            HTTPException: There is more than is allowed.
        """
        message = await self._next()
        if self._total > self._most:
            raise HTTPException(413, f"body of more than {self._most} bytes")
        return message

    async def drain(self) -> None:
        """Read the rest for a moment.

        A connection that is closed with unread bytes is reset, and the client misses the answer.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_DRAIN_S):
                while not self._ended:
                    await self._next()

    async def _next(self) -> Message:
        message = await self._receive()
        self._total += len(message.get("body", b""))
        self._ended = not message.get("more_body", False)
        return message


def _method(scope: MutableMapping[str, Any]) -> str:
    known = ("GET", "POST", "DELETE", "HEAD", "OPTIONS", "PUT", "PATCH")
    return scope["method"] if scope["method"] in known else "other"


def _hostname(host: str) -> str | None:
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


async def _refuse(send: Send, status: int, reason: str) -> None:
    body = json.dumps({"error": reason}).encode()
    headers = [
        (b"content-type", b"application/json"),
        (b"content-length", str(len(body)).encode()),
        (b"connection", b"close"),
    ]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
