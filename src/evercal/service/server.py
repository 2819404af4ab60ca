"""The HTTP service: the application, and the process that serves it."""

import asyncio
import os
import signal
import socket
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import h11
import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from uvicorn.protocols.http.h11_impl import H11Protocol

from evercal.errors import InputError
from evercal.service import routes, scene_routes
from evercal.service.desk import Desk
from evercal.service.guard import Guard, Metrics
from evercal.service.hosts import is_local
from evercal.service.jobs import Jobs, QueueFullError
from evercal.service.limits import Limits, TooLargeError
from evercal.service.live_map import LiveMap

POLL_S = 0.5
"""Interval of the search for changes that other processes make to the map."""
DRAIN_S = 30
"""Time that requests get to finish when the service is stopped."""
LINGER_S = 1.0
LEAST_TOKEN = 16


@dataclass(frozen=True)
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
    recordings: Path | None = None
    """Folder whose recordings may be learned by their path."""
    device: str = "auto"
    """`auto`, `cpu` or `cuda`."""
    limits: Limits = field(default_factory=Limits)
    """Sizes above which a request is refused."""


def make_app(options: ServeOptions) -> FastAPI:
    """The application; its lifespan owns the threads and the folder of uploads.

    Raises:
        InputError: As `LiveMap`.
    """
    live, metrics = LiveMap(options.map, options.device), Metrics()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        with tempfile.TemporaryDirectory(prefix="evercal-serve-") as uploads:
            service = routes.Service(
                live=live,
                jobs=Jobs(options.limits.jobs, live.refresh),
                desk=Desk(options.limits.queue),
                limits=options.limits,
                metrics=metrics,
                uploads=Path(uploads),
                recordings=options.recordings,
                device=options.device,
            )
            app.state.service = service
            polling = asyncio.create_task(_poll(live))
            try:
                yield
            finally:
                polling.cancel()
                try:
                    with suppress(asyncio.CancelledError):
                        await polling
                finally:
                    service.jobs.close()
                    service.desk.close()

    app = FastAPI(title="evercal", version="1", redoc_url=None, lifespan=lifespan)
    app.state.live = live
    app.include_router(routes.router)
    app.include_router(scene_routes.router)
    app.add_middleware(Guard, token=options.token, limits=options.limits, metrics=metrics)  # pyright: ignore[reportArgumentType]
    for kind, answer in _ANSWERS.items():
        app.add_exception_handler(kind, answer)
    return app


async def _poll(live: LiveMap) -> None:
    while True:
        await asyncio.sleep(POLL_S)
        await asyncio.to_thread(live.refresh)


def _error(status: int) -> Callable[[Request, Exception], JSONResponse]:
    def answer(_: Request, error: Exception) -> JSONResponse:
        return JSONResponse({"error": routes.one_line(error)}, status)

    return answer


def _http_error(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": routes.one_line(error.detail)}, error.status_code, error.headers)


def _invalid(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    what = ".".join(str(part) for part in first["loc"][1:]) or "body"
    return JSONResponse({"error": routes.one_line(f"{what}: {first['msg']}")}, 422)


def _internal(_: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"error": "internal error"}, 500)


_ANSWERS: dict[type[Exception], Callable[[Request, Exception], JSONResponse]] = {
    TooLargeError: _error(413),
    InputError: _error(400),
    QueueFullError: _error(429),
    HTTPException: _http_error,
    RequestValidationError: _invalid,
    Exception: _internal,
}


class JsonErrors(H11Protocol):
    """HTTP/1.1 whose answer to what is no HTTP is JSON as all others."""

    _refused = False

    def data_received(self, data: bytes) -> None:
        """Read from a client; what follows a refused request is dropped."""
        if not self._refused:
            super().data_received(data)

    def send_400_response(self, msg: str) -> None:
        """Answer, and close the connection a moment later.

        A connection that is closed with unread bytes is reset, and the client misses the answer.
        """
        self._refused = True
        body = b'{"error": "not a valid HTTP request, or its headers are too large"}'
        headers = [("content-type", "application/json"), ("connection", "close")]
        with suppress(h11.LocalProtocolError):  # an answer is under way
            for event in (
                h11.Response(status_code=400, headers=headers, reason=b"Bad Request"),
                h11.Data(data=body),
                h11.EndOfMessage(),
            ):
                self.transport.write(self.conn.send(event) or b"")
        self.transport.write_eof()
        self.loop.call_later(LINGER_S, self.transport.close)


def bound_socket(options: ServeOptions) -> socket.socket:
    """A socket that listens where the options ask for.

    Raises:
        InputError: An address beyond this machine without a token, a short token, or an address
            that cannot be used.
    """
    token = options.token
    if token is None and not is_local(options.host):
        raise InputError(
            f"--host {options.host}: other machines could use the map; give --token, or set"
            " EVERCAL_TOKEN"
        )
    if token is not None and (len(token) < LEAST_TOKEN or not token.isascii() or " " in token):
        raise InputError(f"--token: give at least {LEAST_TOKEN} ASCII characters without spaces")
    if not 0 <= options.port <= 65_535:  # the resolver takes the remainder
        raise InputError(f"--port {options.port}: give 0 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            options.host, options.port, type=socket.SOCK_STREAM
        )[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
        except BaseException:
            listener.close()
            raise
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"--host {options.host} --port {options.port}: {reason}") from None
    return listener


def url_of(listener: socket.socket) -> str:
    """Address of a service for its clients."""
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


class Server(uvicorn.Server):
    """The server of an application.

    Args:
        app: What `make_app` returns.
        on_ready: Called when it accepts connections.
    """

    def __init__(self, app: FastAPI, on_ready: Callable[[], object] = lambda: None):
        config = uvicorn.Config(
            app,
            http=JsonErrors,
            ws="websockets-sansio",
            ws_max_size=64 * 1024 * 1024,
            ws_max_queue=4,
            loop="asyncio",
            log_level="error",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=DRAIN_S,
        )
        super().__init__(config)
        self._on_ready = on_ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen."""
        await super().startup(sockets)
        self._on_ready()


def serve(options: ServeOptions, on_ready: Callable[[str, tuple[str, ...]], object]) -> None:
    """Serve a map until SIGTERM or SIGINT; requests under way are answered before.

    Args:
        options: How it is served.
        on_ready: Called with the address and the names of the scenes.

    Raises:
        InputError: As `bound_socket` and `make_app`.
    """
    # A second limit, in case that a decoder reads another size than the header states.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(options.limits.pixels))
    if options.recordings is not None and not options.recordings.is_dir():
        raise InputError(f"--recordings {options.recordings}: no such folder")
    with bound_socket(options) as listener:
        app = make_app(options)
        live: LiveMap = app.state.live
        server = Server(app, lambda: on_ready(url_of(listener), live.current.scenes))
        # The server raises the signal again after it has drained.
        signal.signal(signal.SIGTERM, lambda *_: None)
        server.run(sockets=[listener])
