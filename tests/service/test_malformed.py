"""Malformed requests get one line and a status of the client's fault; the service goes on."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest

from evercal.bounds import RequestBounds

from .malformed import PNG, malformed

# The parser of forms leaves the last part of a truncated body to the garbage collector.
pytestmark = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="module")
def narrow(hall_store) -> Iterator[Any]:
    """A service whose images may be small only."""
    from .conftest import running

    with running(hall_store, limits=RequestBounds(pixels=10**6)) as service:
        yield service


def answer_to(service: Any, data: bytes) -> tuple[int, bytes]:
    """Status and body of what comes back for raw bytes."""
    with service.connected(data) as connection:
        answer = b""
        while received := connection.recv(65536):
            answer += received
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]) if head else 0, body


def statuses(service: Any, seeds: range) -> Counter[int]:
    counts: Counter[int] = Counter()
    for seed in seeds:
        status, body = answer_to(service, malformed(seed))
        assert 400 <= status < 500, (seed, status, malformed(seed)[:200])
        if body != b"Invalid HTTP request received.":  # by the parser of HTTP
            error = json.loads(body)
            assert list(error) == ["error"], seed
            assert "\n" not in error["error"], seed
        counts[status] += 1
    assert service.get("/scenes").json == {"scenes": ["hall"]}
    assert service.service.desk.waiting == 0
    return counts


def test_malformed_requests(narrow, image):
    counts = statuses(narrow, range(50))
    assert {400, 404, 413, 415} <= counts.keys()
    row = narrow.post("/localize", image=image).json
    assert row["status"] == "ok"


@pytest.mark.slow("src/evercal/service")
def test_a_thousand_malformed_requests(narrow):
    print(statuses(narrow, range(100, 1100)))  # noqa: T201


@pytest.mark.parametrize(
    ("path", "part", "text"),
    [
        ("/localize", "camera", "a " + "9" * 60_000),
        ("/localize", "camera", "image_width: 640\n" + "1 2\n" * 20_000),
        ("/calibrations", "robot_poses", "pose:" + "\n" * 60_000),
    ],
)
def test_work_is_proportional_to_the_text(
    narrow: Any, path: str, part: str, text: str
) -> None:
    begin = time.perf_counter()
    image = {"image" if part == "camera" else "images": ("a.png", PNG)}
    narrow.post(path, **image, **{part: ("a.csv", text.encode())})
    assert time.perf_counter() - begin < 3


def test_clients_that_vanish(narrow, image):
    """Connections are closed in the middle of a request, and before an answer."""
    body = b"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data;"
    body += b" boundary=edge\r\nContent-Length: 100000\r\n\r\n--edge\r\n"

    def vanish(data: bytes) -> None:
        narrow.connected(data).close()

    threads = [
        threading.Thread(target=vanish, args=(body[: 10 * i],)) for i in range(1, 20)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    got = narrow.post("/localize", image=image)
    assert got.json["status"] == "ok"
    assert narrow.service.desk.waiting == 0
