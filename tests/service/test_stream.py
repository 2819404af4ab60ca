"""Frames of a stream are answered in order, and their number is bounded by bytes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from websockets.sync.client import connect

from evercal.bounds import RequestBounds

from .test_guard import wait_until_closed

FRAMES = 40


@contextmanager
def hasty(serve: Any, store: Any, **limits: Any) -> Iterator[Any]:
    """A service that pings often, and expects an answer soon."""
    with serve(store, limits=RequestBounds(**limits)) as service:
        service.server.config.ws_ping_interval = 0.2
        service.server.config.ws_ping_timeout = 0.2
        yield service


def stream(service: Any, words: str = "") -> Any:
    url = service.url.replace("http", "ws") + "/track" + words
    return connect(url, ping_interval=None, max_size=None)


def test_a_client_that_keeps_up_with_the_answers_is_not_closed(
    serve, hall_store, image
):
    """Its answers to pings wait behind its frames, for longer than the service waits."""
    frame = image.read_bytes()
    with (
        hasty(serve, hall_store, stream_bytes=2 * len(frame)) as service,
        stream(service) as socket,
    ):
        for _ in range(FRAMES):
            socket.send(frame)
        rows = [json.loads(socket.recv(60)) for _ in range(FRAMES)]
    assert [row["frame"] for row in rows] == [*range(FRAMES)]
    assert {row["status"] for row in rows} == {"ok"}
    assert {row["dropped"] for row in rows} == {0}
    waiting = [row["waiting"] for row in rows]
    assert waiting[-1] == 0
    assert 1 <= max(waiting) <= 3


def test_only_the_newest_frame_waits(serve, hall_store, image):
    frame = image.read_bytes()
    with hasty(serve, hall_store) as service, stream(service, "?newest=1") as socket:
        for _ in range(FRAMES):
            socket.send(frame)
        rows = []
        while not rows or rows[-1]["frame"] < FRAMES - 1:
            rows.append(json.loads(socket.recv(60)))
    numbers = [row["frame"] for row in rows]
    assert numbers == sorted(numbers)
    assert len(rows) + sum(row["dropped"] for row in rows) == FRAMES
    assert len(rows) < FRAMES
    assert max(row["waiting"] for row in rows) <= 1


def test_a_silent_client_is_closed(serve, hall_store):
    head = "GET /track HTTP/1.1\r\nHost: localhost\r\nConnection: upgrade\r\n"
    head += "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    head += "Sec-WebSocket-Key: c2VjcmV0IG9mIHRlc3RzIQ==\r\n\r\n"
    with (
        hasty(serve, hall_store) as service,
        service.connected(head.encode()) as silent,
    ):
        assert silent.recv(12).startswith(b"HTTP/1.1 101")
        wait_until_closed(service, silent)


def test_intrinsics_are_of_the_frames_that_follow(hall_service, image, hall):
    camera = json.dumps(hall.test[7].camera.to_dict())
    with stream(hall_service) as socket:
        for text in ("{", camera, "{", camera):
            socket.send(image.read_bytes())
            socket.send(text)
        rows = [json.loads(socket.recv(60)) for _ in range(4)]
    assert ["error" in row for row in rows] == [False, True, False, True]
    assert [row["frame"] for row in rows] == [0, 1, 2, 3]
