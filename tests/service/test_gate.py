"""Pages of viser: nobody without the key, and no page of another origin, connects."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from typing import Any

import pytest
import viser
from websockets.asyncio import server as websockets_server
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from evercal.errors import InputError
from evercal.service.viewer.gate import gated
from evercal.service.viewer.page import start_server


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    started = start_server("127.0.0.1", 0, "page")
    yield started
    started.stop()


def status(server: Any, path: str, **headers: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=20)
    try:
        connection.request("GET", path, headers=headers)
        return connection.getresponse().status
    finally:
        connection.close()


def connected(server: Any, path: str, **headers: str) -> bool:
    """Whether a websocket of the client's version is taken, and gets the page's content."""
    url = f"ws://127.0.0.1:{server.get_port()}{path}"
    version: Any = f"viser-v{viser.__version__}"
    origin: Any = headers.pop("Origin", None)
    try:
        with connect(
            url,
            subprotocols=[version],
            origin=origin,
            additional_headers=headers,
            max_size=None,
        ) as socket:
            return bool(socket.recv(20))
    except InvalidStatus as error:
        if error.response.status_code != 403:
            raise
        return False


def test_only_the_printed_address_shows_the_page(server):
    key = server.key
    assert len(key) > 20
    assert server.url == f"http://127.0.0.1:{server.get_port()}/{key}/"
    for path in ("/KEY/", "/KEY", "/KEY/?a=b"):
        assert status(server, path.replace("KEY", key)) == 200, path
    assert status(server, f"/{key}/none.js") == 404
    for path in ("/", "/index.html", "/KEYx/", "//KEY/", "/?KEY"):
        assert status(server, path.replace("KEY", key)) == 403, path
    assert status(server, f"/{key[:-1]}/") == 403
    assert status(server, f"/{key}/", Host="rebound.example") == 403
    assert status(server, f"/{key}/", Origin="http://page.example") == 403


def test_the_first_page_asks_for_the_colours_of_the_system(server):
    """The page that it leads to is viser's; a reload of that asks no more."""
    shown = {}
    for path in (f"/{server.key}/", f"/{server.key}/?light"):
        connection = http.client.HTTPConnection("127.0.0.1", server.get_port())
        connection.request("GET", path)
        shown[path] = connection.getresponse().read().decode()
        connection.close()
    first, then = shown.values()
    assert "prefers-color-scheme: dark" in first
    assert "?darkMode" in first
    assert len(first) < 1000 < len(then)


def test_no_page_of_another_origin_connects(server):
    key = server.key
    here = f"http://127.0.0.1:{server.get_port()}"
    assert connected(server, f"/{key}", Origin=here)
    assert connected(server, f"/{key}")  # a program that was given the address
    assert not connected(server, "/", Origin=here)
    assert not connected(server, f"/{key}x", Origin=here)
    for origin in ("http://page.example", "null", "http://127.0.0.1:1", "file://"):
        assert not connected(server, f"/{key}", Origin=origin), origin
    other = {"Host": "rebound.example", "Origin": "http://rebound.example"}
    assert status(server, f"/{key}/", **other) == 403


def test_a_page_for_other_machines_takes_their_names_with_the_key():
    started = start_server("0.0.0.0", 0, "page")
    try:
        assert started.url.startswith("http://127.0.0.1:")
        name = {"Host": "robot.example"}
        assert status(started, f"/{started.key}/", **name) == 200
        assert status(started, "/", **name) == 403
        assert (
            status(started, f"/{started.key}/", **name, Origin="http://page.example")
            == 403
        )
    finally:
        started.stop()


def test_a_server_that_is_opened_otherwise_is_refused():
    before = websockets_server.serve
    with pytest.raises(InputError, match="viser"), gated("key", True):
        pass
    assert websockets_server.serve is before
