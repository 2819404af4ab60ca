"""The HTTP service: the application, and the process that serves it."""

import asyncio
import logging
import signal
import socket
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import field
from pathlib import Path

import uvicorn
from fastapi import FastAPI, Request, Security
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.responses import HTMLResponse, JSONResponse
from fastapi.security import HTTPBearer
from starlette.exceptions import HTTPException
from starlette.staticfiles import StaticFiles

from evercal.bounds import RequestBounds, TooLargeError, request_bounds
from evercal.classes import frozen
from evercal.errors import InputError, UnavailableError
from evercal.service import hosts, routes
from evercal.service.connection import protocols
from evercal.service.desk import Desk
from evercal.service.guard import PAGES, Guard, Metrics
from evercal.service.live_map import LiveMap
from evercal.service.schemas import DESCRIPTION, TAGS
from evercal.typing import Strings

POLL_S = 0.5
"""Interval of the search for changes that other processes make to the map."""
DRAIN_S = 30
"""Time that requests get to finish when the service is stopped."""
WORK_S = 20
"""After this time of it, work is asked to end before its next image."""
LEAST_TOKEN = 16
"""Characters of a token, at least."""


@frozen
class ServeOptions:
    """How a map is served."""

    map: Path
    """Folder of the map; it may be missing until a first scene is learned."""
    host: str = "127.0.0.1"
    """Address to listen on; others than this machine's own need a token."""
    port: int = 8000
    """0 for any free port."""
    token: str | None = None
    """Requests must have it as bearer token."""
    limits: RequestBounds = field(default_factory=request_bounds)
    """Sizes above which a request is refused."""
    known: bool = False
    """Whether there is a map already, so that a missing folder is a fault."""


def make_app(
    options: ServeOptions,
    on_ready: Callable[[Strings], object] = lambda _: None,
) -> FastAPI:
    """The application; `on_ready` gets the names of the scenes when requests are answered."""
    live = LiveMap(options.map, options.known)
    metrics = Metrics()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        desk = Desk()
        app.state.service = routes.Service(live, desk, options.limits, metrics)
        polling = asyncio.create_task(_poll(live))
        on_ready(live.current.scenes)
        try:
            yield
        finally:
            polling.cancel()
            with suppress(asyncio.CancelledError):
                await polling
            desk.close()

    app = FastAPI(
        title="evercal",
        version="1",
        description=DESCRIPTION,
        openapi_tags=TAGS,
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
    )
    # Only for the page, which then can send the token; the guard compares it.
    bearer = [Security(HTTPBearer(auto_error=False))] if options.token else []
    app.include_router(routes.router, dependencies=bearer)
    app.mount(PAGES, StaticFiles(packages=[("fastapi_swagger", "resources")]))
    app.get("/docs", include_in_schema=False)(_page)
    app.add_middleware(
        Guard, token=options.token, limits=options.limits, metrics=metrics
    )  # pyright: ignore[reportArgumentType]
    for kind in (*_STATUS, HTTPException, RequestValidationError, Exception):
        app.add_exception_handler(kind, _answer)
    return app


_DARK = """<script>
if (matchMedia("(prefers-color-scheme: dark)").matches)
  document.documentElement.classList.add("dark-mode");
</script></head>"""
"""End of the head of a page that follows the browser."""


def _page() -> HTMLResponse:
    files = PAGES.lstrip("/")
    page = get_swagger_ui_html(
        openapi_url="openapi.json",
        title="evercal",
        swagger_js_url=f"{files}swagger-ui-bundle.js",
        swagger_css_url=f"{files}swagger-ui.css",
        swagger_favicon_url=f"{files}favicon-32x32.png",
        swagger_ui_parameters={"tryItOutEnabled": True},
    )
    return HTMLResponse(bytes(page.body).decode().replace("</head>", _DARK))


async def _poll(live: LiveMap) -> None:
    while True:
        await asyncio.sleep(POLL_S)
        await asyncio.to_thread(live.refresh)


def _answer(request: Request, error: Exception) -> JSONResponse:
    request.app.state.service.live.failed(error)
    if isinstance(error, HTTPException):
        return _line(error.detail, error.status_code, error.headers)
    if isinstance(error, RequestValidationError):
        first = error.errors()[0]
        what = ".".join(str(part) for part in first["loc"][1:]) or "body"
        return _line(f"{what}: {first['msg']}", 422)
    for kind, status in _STATUS.items():
        if isinstance(error, kind):
            return _line(error, status)
    return _line("internal error", 500)


def _line(
    error: object, status: int, headers: Mapping[str, str] | None = None
) -> JSONResponse:
    return JSONResponse({"error": routes.one_line(error)}, status, headers)


_STATUS = {TooLargeError: 413, UnavailableError: 503, InputError: 400}
"""HTTP status of an error; the first kind that fits counts."""


def bound_socket(options: ServeOptions) -> socket.socket:
    """A socket that listens where the options ask for."""
    token = options.token
    if token is None and not hosts.is_local(options.host):
        raise InputError(
            f"`host` {options.host}: other machines could use the map; give `token_file`, or set"
            " EVERCAL_TOKEN"
        )
    if token is not None:
        require_token(token)
    return hosts.listening_socket(options.host, options.port)


def require_token(token: str) -> None:
    """Refuse a token that is easily guessed, or that a header cannot hold."""
    if len(token) < LEAST_TOKEN or not token.isascii() or " " in token:
        raise InputError(
            f"token: give at least {LEAST_TOKEN} ASCII characters without spaces"
        )


def url_of(listener: socket.socket) -> str:
    """Address of a service for its clients."""
    return hosts.url_of(*listener.getsockname()[:2])


class _Server(uvicorn.Server):
    """A server whose work ends in time when it is stopped."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        desk = self.config.app.state.service.desk  # pyright: ignore
        asyncio.get_running_loop().call_later(WORK_S, desk.stop)
        await super().shutdown(sockets)


def server_of(app: FastAPI, limits: RequestBounds) -> uvicorn.Server:
    """The server of what `make_app` returns."""
    # It logs every malformed form.
    logging.getLogger("python_multipart").setLevel(logging.CRITICAL)
    requests, streams = protocols(limits)
    return _Server(
        uvicorn.Config(
            app,
            http=requests,
            # The guard refuses headers with an answer, if they end.
            h11_max_incomplete_event_size=8 * limits.header_bytes,
            ws=streams,
            ws_max_size=limits.frame_bytes,
            ws_per_message_deflate=False,
            loop="asyncio",
            log_level="error",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=DRAIN_S,
        )
    )


def serve(options: ServeOptions, on_ready: Callable[[str, Strings], object]) -> None:
    """Serve a map until SIGTERM or SIGINT; requests under way are answered before.

    `on_ready` gets the address and the names of the scenes.
    """
    with bound_socket(options) as listener:
        app = make_app(options, lambda scenes: on_ready(url_of(listener), scenes))
        # The server raises the signal again after it has drained.
        signal.signal(signal.SIGTERM, lambda *_: None)
        server_of(app, options.limits).run(sockets=[listener])
