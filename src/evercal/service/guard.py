"""Checks before a request is handled: token, origin, size. Requests are counted here, too."""

import asyncio
import hmac
import time
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from starlette.responses import JSONResponse

from evercal.service.hosts import is_local
from evercal.service.limits import Limits

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[MutableMapping[str, Any], Receive, Send], Awaitable[None]]
OPEN = ("/health", "/docs", "/openapi.json")
"""Paths without a token: they reveal nothing of the map."""
_METHODS = ("GET", "POST", "DELETE", "HEAD", "OPTIONS", "PUT", "PATCH")


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
        self.answers = Counter("evercal_answers", "Located images.", ("status",), registry=to)
        self.scenes = Gauge("evercal_scenes", "Scenes of the map.", registry=to)
        self.waiting = Gauge("evercal_waiting_images", "Images in the queue.", registry=to)


class Guard:
    """Refuses requests before their body is read; an ASGI middleware.

    Without a token, only this machine may ask.
    """

    def __init__(self, app: App, token: str | None, limits: Limits, metrics: Metrics):
        self._app, self._most, self._metrics = app, limits.body_bytes, metrics
        self._token = None if token is None else token.encode()

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        headers = dict(scope["headers"])
        refusal = self._refusal(scope["path"], headers)
        if scope["type"] == "websocket":
            if refusal is not None:  # the handshake gets status 403
                return await send({"type": "websocket.close", "code": 1008, "reason": refusal[1]})
            return await self._app(scope, receive, send)
        began, status, ended = time.perf_counter(), 500, False

        async def part() -> Message:
            nonlocal ended
            message = await receive()
            ended = not message.get("more_body", False)
            return message

        async def counted(message: Message) -> None:
            nonlocal status
            status = message.get("status", status)
            if "status" in message and status >= 400 and b"expect" not in headers:
                # A connection that is closed with unread bytes is reset: the answer would be lost.
                with suppress(TimeoutError):
                    async with asyncio.timeout(1.0):
                        while not ended:
                            await part()
            await send(message)

        try:
            answer = self._app if refusal is None else _refused(*refusal)
            await answer(scope, part, counted)
        finally:
            route = getattr(scope.get("route"), "path", "other")
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self._metrics.requests.labels(method, route, status).inc()
            self._metrics.seconds.labels(route).observe(time.perf_counter() - began)

    def _refusal(self, path: str, headers: dict[bytes, bytes]) -> tuple[int, str] | None:
        """Status and reason for refusing a request."""
        if self._token is not None and path not in OPEN:
            given = headers.get(b"authorization", b"")
            # Compared in constant time, so that its duration reveals nothing of the token.
            if not hmac.compare_digest(given, b"Bearer " + self._token):
                return 401, "send 'Authorization: Bearer TOKEN'"
        elif self._token is None:
            # Pages that a browser on this machine shows must not reach the map.
            host = headers.get(b"host", b"").decode("latin-1")
            if not is_local(_hostname(host)):
                return 403, f"host {host[:100]!r} is not this machine; a token is needed"
            origin = headers.get(b"origin")
            if origin is not None and origin.decode("latin-1").partition("://")[2] != host:
                return 403, "requests of other web pages are refused; a token is needed"
        if b"transfer-encoding" in headers:
            return 411, "bodies of unknown length are refused; send content-length"
        length = int(headers.get(b"content-length", b"0"))  # the server has checked that it is one
        if length > self._most:
            return 413, f"body of {length} bytes; at most {self._most}"
        return None


def _hostname(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _refused(status: int, reason: str) -> JSONResponse:
    headers = {"connection": "close"}
    if status == 401:
        headers["www-authenticate"] = "Bearer"
    return JSONResponse({"error": reason}, status, headers)
