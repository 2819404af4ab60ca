"""What waits holds nobody else: stalled uploads, clients that left, a service that is stopped."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import Any

import pytest

from evercal.bounds import RequestBounds
from evercal.processes import cores
from evercal.service import limits, routes, server

from .test_guard import wait_until_closed

BOUNDARY = "multipart/form-data; boundary=edge"
START = b'--edge\r\nContent-Disposition: form-data; name="image"; filename="a"\r\n\r\n'
END = b"\r\n--edge--\r\n"


def upload(path: str, length: int, content: bytes) -> bytes:
    """The beginning of a request, whose body is longer or shorter than stated."""
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {BOUNDARY}\r\n"
    return f"{head}Content-Length: {length}\r\n\r\n".encode() + content


def test_stalled_uploads_hold_nobody_else(serve, hall_store, image):
    bounds = RequestBounds(requests=2, wait_s=1.5)
    with serve(hall_store, limits=bounds) as service:
        large = upload("/localize", bounds.body_bytes, START)
        stalled = [service.connected(large) for _ in range(8)]
        began = time.monotonic()
        assert service.post("/localize", image=image).json["status"] == "ok"
        assert time.monotonic() - began < 1.5
        for connection in stalled:
            with connection:
                assert connection.recv(10_000).startswith(b"HTTP/1.1 408 ")


def test_a_body_that_keeps_arriving_is_read(serve, hall_store, image):
    bounds = RequestBounds(wait_s=0.5, bytes_per_s=30_000)
    with serve(hall_store, limits=bounds) as service:
        content = START + bytes(300_000)
        with service.connected(upload("/localize", len(content) + 12, b"")) as slow:
            for i in range(0, len(content), 20_000):
                slow.sendall(content[i : i + 20_000])
                time.sleep(0.1)
            slow.sendall(END)
            answer = b""
            while not answer.endswith(b"}"):
                answer += slow.recv(10_000)
    assert answer.startswith(b"HTTP/1.1 400 ")
    assert b"a: not a readable image (300000 bytes)" in answer


def test_bodies_that_arrive_take_no_more_memory_than_allowed(serve, hall_store, image):
    bounds = RequestBounds(held_bytes=1_000_000)
    with serve(hall_store, limits=bounds) as service:
        request = upload("/localize", 900_000, START + bytes(600_000))
        with service.connected(request), service.connected(request) as second:
            assert second.recv(10_000).startswith(b"HTTP/1.1 429 ")
            got = service.post("/localize", image=image)
            assert got.status == 200


@pytest.mark.parametrize(
    ("path", "name"), [("/localize", b"image"), ("/calibrations", b"images")]
)
def test_work_of_clients_that_left_is_dropped(
    hall_service, image, monkeypatch, path, name
):
    decoded = []
    monkeypatch.setattr(routes, "decoded", lambda *words: decoded.append(words))
    monkeypatch.setattr(limits, "decoded", lambda *words: decoded.append(words))
    desk: Any = hall_service.service.desk
    free = threading.Event()
    for _ in range(cores()):
        desk._pool.submit(free.wait)
    content = START.replace(b"image", name) + image.read_bytes() + END
    request = upload(path, len(content), content)
    asking = [hall_service.connected(request) for _ in range(10)]
    try:
        assert waited_for(desk, 10)
        for connection in asking:
            connection.close()
        assert waited_for(desk, 0)
    finally:
        free.set()
    desk._pool.submit(int).result()
    assert decoded == []


def waited_for(desk: Any, count: int) -> bool:
    """Whether there are soon as many images in the queue."""
    until = time.monotonic() + 10
    while desk.waiting != count and time.monotonic() < until:
        time.sleep(0.01)
    return desk.waiting == count


def test_long_work_ends_when_the_service_is_stopped(
    serve, hall_store, image, monkeypatch
):
    monkeypatch.setattr(server, "WORK_S", 0.3)
    with serve(hall_store) as service:
        answers = []

        def ask() -> None:
            answers.append(service.post("/calibrations", images=[image] * 300))

        asking = [threading.Thread(target=ask) for _ in range(3)]
        for thread in asking:
            thread.start()
        while service.service.desk.waiting < 3:
            time.sleep(0.01)
        began = time.monotonic()
        service.server.should_exit = True
        for thread in asking:
            thread.join()
        assert time.monotonic() - began < 5
    refusal = (503, "the service is being stopped; ask again")
    assert [answer.refusal for answer in answers] == [refusal] * 3


def test_work_that_does_not_end_is_answered_all_the_same(
    serve, hall_store, image, monkeypatch
):
    monkeypatch.setattr(server, "DRAIN_S", 0.5)
    free = threading.Event()
    with serve(hall_store) as service:
        monkeypatch.setattr(routes, "decoded", lambda *_: free.wait(20))
        answers = []
        asking = threading.Thread(
            target=lambda: answers.append(service.post("/localize", image=image))
        )
        asking.start()
        while service.service.desk.waiting < 1:
            time.sleep(0.01)
        service.server.should_exit = True
        asking.join()
        free.set()
    assert answers[0].refusal == (503, "the service is being stopped; ask again")


@pytest.mark.parametrize("size", [33_000, 100_000, 200_000])
@pytest.mark.parametrize("where", ["path", "header"])
def test_long_headers_are_answered(hall_service, size, where):
    data = b"GET /health HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * size
    if where == "path":
        data = b"GET /" + b"x" * size + b" HTTP/1.1\r\nHost: localhost"
    with hall_service.connected(data + b"\r\n\r\n") as connection:
        answer = b""
        with suppress(TimeoutError):
            while received := connection.recv(65536):
                answer += received
        assert answer.startswith(b"HTTP/1.1 431 ")
        assert b'{"error"' in answer
        wait_until_closed(hall_service, connection)


def test_headers_up_to_the_limit_are_read(hall_service):
    assert hall_service.get("/health", X="x" * 32_000).status == 200
