"""The gate of viser's server: who lacks the key of the printed address comes no further.

viser checks neither where a request comes from nor who sends it, and has no setting for that. So
the function that opens its server is replaced while it starts.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from evercal.errors import InputError
from evercal.service.hosts import refusal

_START = """<!doctype html><title>evercal</title><script>
const dark = matchMedia("(prefers-color-scheme: dark)").matches;
location.replace(dark ? "?darkMode" : "?light");
</script>"""
"""Leads to viser's page as light or as dark as the visitor's system, which viser does not ask."""


@contextmanager
def gated(key: str, local: bool) -> Iterator[None]:
    """Gate the servers that are opened meanwhile.

    Args:
        key: First part of the path of every request.
        local: Whether `Host` must name this machine.
    """
    opened = []
    serve = websockets.asyncio.server.serve

    def gated_serve(
        handler: Any, *address: Any, process_request: Any, **options: Any
    ) -> Any:
        def process(connection: ServerConnection, request: Request) -> Response | None:
            if reason := refusal(request.path, request.headers, key, local):
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            path = request.path.removeprefix(f"/{key}")
            if path in ("", "/") and "Upgrade" not in request.headers:
                return _page(_START)
            return process_request(connection, Request(path or "/", request.headers))

        opened.append(address)
        return serve(handler, *address, process_request=process, **options)

    websockets.asyncio.server.serve = gated_serve  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
    if not opened:  # it would be open to everyone
        raise InputError(
            "this version of viser opens its server otherwise; see constraints.txt"
        )


def _page(html: str) -> Response:
    headers = Headers({"Content-Type": "text/html", "Cache-Control": "no-store"})
    return Response(HTTPStatus.OK, "OK", headers, html.encode())


def chosen(dropdown: Any) -> Any:
    """What a page has chosen of a list; the first where it has sent anything else."""
    if dropdown.value not in dropdown.options:
        dropdown.value = dropdown.options[0]
    return dropdown.value
