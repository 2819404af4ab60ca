"""Who may ask, and how much a request may hold."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from evercal.bounds import RequestBounds
from evercal.errors import InputError
from evercal.service.guard import Guard, Metrics
from evercal.service.hosts import is_local
from evercal.service.server import ServeOptions, bound_socket

TOKEN = "a-token-of-32-characters-or-more"


@pytest.fixture(scope="module")
def guarded(hall_store) -> Iterator[Any]:
    from .conftest import running

    limits = RequestBounds(body_bytes=100_000)
    with running(hall_store, token=TOKEN, limits=limits) as service:
        yield service


@pytest.mark.parametrize(
    ("given", "status"),
    [
        (f"Bearer {TOKEN}", 200),
        (f"Bearer {TOKEN}x", 401),
        (f"Bearer {TOKEN[:-1]}", 401),
        (TOKEN, 401),
        ("Bearer ", 401),
        ("", 401),
        (None, 401),
        ("Bearer \xe9", 401),
    ],
)
def test_a_token_is_needed(guarded, given, status):
    headers = {} if given is None else {"Authorization": given}
    got = guarded.get("/scenes", **headers)
    assert got.status == status
    if status == 401:
        assert got.refusal == (401, "send 'Authorization: Bearer TOKEN'")
        assert got.headers["www-authenticate"] == "Bearer"


def test_what_needs_no_token_holds_nothing_of_the_map(guarded):
    assert guarded.get("/health").status == 200
    for path in ("/docs", "/openapi.json"):
        got = guarded.get(path)
        assert got.status == 200
        assert b"hall" not in got.body
    assert guarded.get("/metrics").status == 401
    with pytest.raises(InvalidStatus, match="403"):
        connect(guarded.url.replace("http", "ws") + "/track")
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with connect(
        guarded.url.replace("http", "ws") + "/track", additional_headers=headers
    ) as ws:
        ws.send(b"x")
        assert "error" in str(ws.recv())


def test_long_bodies_are_refused_before_they_are_read(guarded):
    headers = {"Authorization": f"Bearer {TOKEN}"}
    for size, status in ((100_001, 413), (99_000, 422)):
        got = guarded.ask("POST", "/localize", b"x" * size, headers)
        assert got.refusal[0] == status
    chunks = iter([b"x" * 1000] * 10)  # http.client sends an iterator in chunks
    assert guarded.ask("POST", "/localize", chunks, headers).refusal[0] == 411
    got = guarded.ask("POST", "/localize", b"x" * 200_000)  # without a token
    assert got.status == 401


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost"}, 200),
        ({"Host": "LOCALHOST:80"}, 200),
        ({"Host": "[::1]:80"}, 200),
        ({"Host": "evil.example"}, 403),
        ({"Host": "127.0.0.1.evil.example"}, 403),
        ({"Host": "[::1"}, 403),
        ({"Host": "localhost", "Origin": "http://localhost"}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
    ],
)
def test_web_pages_do_not_reach_a_service_without_a_token(
    hall_service, headers, status
):
    got = hall_service.get("/scenes", **headers)
    assert got.status == status
    assert list(got.json) == (["scenes"] if status == 200 else ["error"])


@pytest.mark.parametrize(
    "data",
    [
        b"garbage\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" * 10,
        b"GET /health HTTP/1.1\r\nX: " + b"x" * 200_000 + b"\r\n\r\n",
        b"GET /health HTTP/9.9\r\n\r\n",
        b"POST /localize HTTP/1.1\r\nHost: a\r\nContent-Length: x\r\n\r\n",
        b"POST /localize HTTP/1.1\r\nHost: a\r\nContent-Length: -1\r\n\r\n",
        b"GET /\0 HTTP/1.1\r\nHost: a\r\n\r\n",
    ],
)
def test_what_is_no_http_is_refused(hall_service, data):
    with hall_service.connected(data) as connection:
        answer = b""
        with suppress(ConnectionResetError):  # the rest of long headers is not read
            while received := connection.recv(65536):
                answer += received
    assert answer.startswith(b"HTTP/1.1 4") or len(data) > 100_000
    assert hall_service.get("/health").status == 200


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"host": "0.0.0.0"},
            "`host` 0.0.0.0: other machines could use the map; give `token_",
        ),
        ({"host": "::"}, "`host` ::: other machines"),
        ({"host": "example.invalid"}, "other machines"),
        ({"token": "short"}, "token: give at least 16"),
        ({"token": "x" * 20 + " "}, "token: give at least 16"),
        (
            {"host": "example.invalid", "token": TOKEN},
            "`host` example.invalid `port` 0: ",
        ),
        ({"port": 70_000}, "`port` 70000: "),
    ],
)
def test_addresses_that_are_refused(options, message, tmp_path):
    with pytest.raises(InputError, match=message.replace(".", r"\.")):
        bound_socket(ServeOptions(tmp_path, **{"port": 0, **options}))


def test_a_token_opens_all_addresses_and_a_port_is_used_once(tmp_path):
    with bound_socket(ServeOptions(tmp_path, "0.0.0.0", 0, TOKEN)) as first:
        port = first.getsockname()[1]
        with pytest.raises(InputError, match=f"`port` {port}: Address already in use"):
            bound_socket(ServeOptions(tmp_path, "0.0.0.0", port, TOKEN))


def test_only_loopback_addresses_are_local():
    assert [is_local(host) for host in ("127.0.0.1", "::1", "localhost")] == [True] * 3
    assert [is_local(host) for host in ("0.0.0.0", "192.168.1.4", "robot")] == [
        False
    ] * 3


def test_what_serve_takes_for_local_is_answered(hall_store):
    from .conftest import running

    with running(hall_store, host="127.0.0.2") as service:
        assert service.url.startswith("http://127.0.0.2:")
        assert service.get("/scenes").status == 200


@pytest.fixture(scope="module")
def hasty(hall_store) -> Iterator[Any]:
    """A service with few connections, which waits for half a second."""
    from .conftest import running

    with running(
        hall_store, limits=RequestBounds(connections=8, streams=2, wait_s=0.5)
    ) as service:
        yield service


def test_half_a_header_is_closed_and_does_not_hold_a_connection(hasty):
    half = [
        hasty.connected(b"GET /health HTTP/1.1\r\nHost: localhost\r\n")
        for _ in range(30)
    ]
    assert hasty.get("/health").status == 200
    for connection in half:
        with suppress(ConnectionResetError):
            assert connection.recv(10_000) == b""
    first = hasty.connected(b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n")
    answer = b""
    while not answer.endswith(b"}"):
        answer += first.recv(10_000)
    first.sendall(b"GET /hea")  # after a whole request
    with suppress(ConnectionResetError):
        assert first.recv(10_000) == b""
    for connection in (first, *half):
        connection.close()


def test_a_body_has_a_deadline(hasty):
    head = b"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5000\r\n"
    head += b"Content-Type: multipart/form-data; boundary=a\r\n\r\n"
    head += b'--a\r\nContent-Disposition: form-data; name="image"; filename="b"\r\n\r\n'
    with hasty.connected(head) as slow:
        for _ in range(20):
            time.sleep(0.1)
            with suppress(OSError):
                slow.sendall(b"-")
        assert slow.recv(10_000).startswith(b"HTTP/1.1 408 ")


def test_streams_are_bounded_in_number_and_size(hasty):
    url = hasty.url.replace("http", "ws") + "/track"
    with connect(url), connect(url), pytest.raises(InvalidStatus, match="403"):
        connect(url)
    with connect(url) as stream:
        with suppress(ConnectionClosed):
            stream.send(bytes(20_000_000))
        with pytest.raises(ConnectionClosed):
            stream.recv()
    assert hasty.get("/health").status == 200


def test_forms_of_other_encodings_are_refused(hall_service):
    kind = {"Content-Type": "multipart/form-data; boundary=a; charset=punycode"}
    got = hall_service.ask("POST", "/localize", b"--a--", kind)
    assert got.refusal == (415, "send forms in UTF-8")


def test_who_reads_no_answers_is_closed(hasty):
    page = b"GET /pages/swagger-ui-bundle.js HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with hasty.connected(page * 20) as silent:
        wait_until_closed(hasty, silent)


def test_a_handshake_has_a_deadline(hasty):
    head = b"POST /track HTTP/1.1\r\nHost: localhost\r\nConnection: upgrade\r\n"
    with hasty.connected(head + b"Upgrade: websocket\r\n\r\n") as odd:
        wait_until_closed(hasty, odd)


def wait_until_closed(service: Any, connection: socket.socket) -> None:
    """The service keeps no connection with the other end of this one."""
    mine = connection.getsockname()[1]
    deadline = time.monotonic() + 20
    while any(c.client == ("127.0.0.1", mine) for c in service.connections):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert service.get("/health").status == 200


def guard_of(app: Any) -> Guard:
    return Guard(app, None, RequestBounds(), Metrics())


SCOPE = {
    "type": "http",
    "method": "POST",
    "path": "/localize",
    "query_string": b"",
    "headers": [(b"host", b"localhost"), (b"content-length", b"1")],
}


@pytest.mark.parametrize("begun", [False, True])
def test_work_that_the_server_cancels_is_answered_once(begun):
    """Its patience is over: 503, unless the answer has begun."""
    sent = []

    async def send(message):
        sent.append(message)

    async def receive():
        return {"type": "http.request", "body": b"x"}

    async def endless(scope, receive, send):
        if begun:
            await send({"type": "http.response.start", "status": 200})
        await asyncio.sleep(3600)

    async def cancelled():
        task = asyncio.create_task(guard_of(endless)(SCOPE, receive, send))
        await asyncio.sleep(0.01)
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        assert task.cancelled() == begun

    asyncio.run(cancelled())
    assert [one["status"] for one in sent if "status" in one] == [200 if begun else 503]


def test_a_body_ends_with_the_message_that_says_no_more():
    """Servers may leave `more_body` out of the last one; nothing is waited for after it."""
    read = []

    async def send(message): ...

    async def receive():
        read.append(1)
        await asyncio.sleep(0)
        return {"type": "http.request", "body": b"x"}

    async def refuses(scope, receive, send):
        await send({"type": "http.response.start", "status": 422})

    asyncio.run(guard_of(refuses)(SCOPE, receive, send))
    assert len(read) == 1


def test_answers_are_sent_at_once(hall_service):
    # With Nagle's algorithm, those on a connection that stays open wait for the client's delayed
    # acknowledgement.
    with hall_service.connected(
        b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n"
    ) as ours:
        assert ours.recv(100)
        for connection in hall_service.connections:
            own = connection.transport.get_extra_info("socket")
            assert own.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
