"""The page on which points are picked: what it serves, and to whom."""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.picked_points import read_picks
from evercal.recordings import write_image
from evercal.recordings.images import decode_image
from evercal.service.picking import PickServer


@pytest.fixture
def server(tmp_path: Path) -> Iterator[PickServer]:
    image = tmp_path / "images" / "a,1.png"
    image.parent.mkdir()
    write_image(image, np.full((48, 64, 3), 90, np.uint8))
    with PickServer(
        [image], ["tip", "tip", "edge</script>"], tmp_path / "picks.csv"
    ) as server:
        thread = threading.Thread(target=server.wait, daemon=True)
        thread.start()
        yield server
        ask(server, "POST", "/picks", b'[["images/a,1.png", "tip", 1, 2]]')
        thread.join(10)
        assert not thread.is_alive()


def ask(
    server: PickServer,
    method: str,
    path: str,
    body: bytes = b"",
    headers: dict[str, str] | None = None,
) -> tuple[int, bytes]:
    """Status and content of an answer; the path is below the key unless it begins with `//`."""
    key = "" if path.startswith("//") else f"/{server.key}"
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    try:
        connection.request(method, key + path, body, headers or {})
        answer = connection.getresponse()
        return answer.status, answer.read()
    except OSError:
        return 0, b""
    finally:
        connection.close()


def test_points_are_picked(server: PickServer) -> None:
    status, page = ask(server, "GET", "/")
    assert status == 200
    assert b"Pick touched points" in page
    assert b'"points": ["tip", "edge\\u003c/script>"]' in page
    status, data = ask(server, "GET", "/image/0")
    image = decode_image(np.frombuffer(data, np.uint8))
    assert status == 200
    assert image is not None
    assert image.shape == (48, 64, 3)
    rows = [
        ["images/a,1.png", "tip", 12.345, 6.0],
        ["images/a,1.png", "edge, left", 1, 2],
    ]
    status, text = ask(server, "POST", "/picks", json.dumps(rows).encode())
    assert (status, text) == (200, b"wrote 2 picks; close this page")
    first, second = read_picks(server.out)
    assert first[:2] == ("images/a,1.png", "tip")
    np.testing.assert_allclose(first.pixel, [12.35, 6], atol=0.011)
    assert second.point == "edge, left"


def test_others_are_refused(server: PickServer) -> None:
    assert ask(server, "GET", "//")[0] == 403
    assert ask(server, "GET", "//image/0")[0] == 403
    assert ask(server, "POST", "//picks", b"[]")[0] == 403
    for headers in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
        assert ask(server, "GET", "/", headers=headers)[0] == 403
        assert ask(server, "POST", "/picks", b"[]", headers)[0] == 403
    assert not server.out.exists()


def test_only_picks_are_written(server: PickServer) -> None:
    for path in ("/image/1", "/image/-1", "/image/00", "/../picks.csv", "/image/0/.."):
        assert ask(server, "GET", path)[0] == 404
    for body in (
        b"",
        b"[]",
        b"{}",
        b"[1]",
        b'[["images/b.png", "tip", 1, 2]]',
        b'[["images/a,1.png", "", 1, 2]]',
        b'[["images/a,1.png", "tip", "x", 2]]',
        b'[["images/a,1.png", "t\\nip", 1, 2]]',
        b'[["images/a,1.png", "tip", NaN, 2]]',
        b"[" * 100_000,
    ):
        assert ask(server, "POST", "/picks", body)[0] == 400
    assert ask(server, "POST", "/image/0", b"[]")[0] == 400
    assert not server.out.exists()
    assert not server.done
