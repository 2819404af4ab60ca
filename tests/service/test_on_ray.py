"""A map on Ray Serve: the answers, the token and the limits of `evercal serve`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from evercal.cli import main
from evercal.errors import InputError
from evercal.map import Map
from evercal.service.client import Client
from evercal.service.hosts import listening_socket

TOKEN = "a-token-of-this-test"
pytestmark = [
    pytest.mark.slow("src/evercal/service"),
    pytest.mark.filterwarnings("ignore"),  # of Ray: open sockets
]


def free_port() -> int:
    with listening_socket("127.0.0.1", 0) as listener:
        return listener.getsockname()[1]


def served_by(*words: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "evercal", "serve", *map(str, words), "--json"]
    environment = {**os.environ, "EVERCAL_TOKEN": TOKEN}
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, env=environment, stdout=pipe, stderr=pipe, text=True
    )


@contextmanager
def served(*words: object) -> Iterator[dict[str, Any]]:
    """What `evercal serve --json` prints; it ends without an error."""
    with served_by(*words) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        lines = ""
        while not lines.rstrip().endswith("}"):
            line = process.stdout.readline()
            assert line, process.stderr.read()
            lines += line
        yield json.loads(lines)
        process.send_signal(signal.SIGTERM)
        assert process.wait(90) == 0
        assert process.stderr.read() == ""


def test_replicas_answer_as_one_process(serve, copy, image, cluster, tmp_path):
    with serve(copy, token=TOKEN) as one:
        header = {"Authorization": f"Bearer {TOKEN}"}
        expected = one.post("/localize", header, image=image).json
    words = ("--ray", cluster.address, "--replicas", 2, "--port", free_port())
    with served(copy, *words) as ready:
        client = Client(ready["url"], TOKEN)
        assert client.scenes == ("hall",)
        for _ in range(4):
            estimate: Any = client.localize(image)
            position = estimate.base_from_camera.translation_m.tolist()
            assert position == expected["base_from_camera"]["translation_m"]
            assert estimate.covariance.tolist() == expected["covariance"]
        with pytest.raises(InputError, match="Authorization: Bearer TOKEN"):
            _ = Client(ready["url"]).scenes
        large = tmp_path / "large.png"
        large.write_bytes(b"\0" * 129_000_000)
        with pytest.raises(InputError, match="body of 129000"):
            client.localize(large)
        with served_by(copy, *words) as process:
            assert "serves a map already" in process.communicate()[1]
        assert process.returncode == 2
        Map.open(copy).rename("hall", "lobby")
        until = time.monotonic() + 20
        while {client.scenes for _ in range(4)} != {("lobby",)}:
            assert time.monotonic() < until
            time.sleep(0.1)
        assert client.localize(image).scene == "lobby"
    # Serve was started by the command, and ends with it.
    port = int(ready["url"].rpartition(":")[2])
    with listening_socket("127.0.0.1", port):
        pass


@pytest.mark.parametrize(
    ("words", "token", "message"),
    [
        ("--ray 127.0.0.1:1", TOKEN, "--ray 127.0.0.1:1: nothing answers"),
        ("--ray auto --replicas 0", TOKEN, "--replicas 0: give a number >= 1"),
        ("--ray auto --port 0", TOKEN, "--port 0: give 1 to 65535"),
        ("--replicas 2", TOKEN, "--replicas 2: give --ray, too"),
        (
            "--ray auto",
            "",
            "--ray: other machines could use the map; give --token-file",
        ),
    ],
)
def test_refusals(words, token, message, hall_store, monkeypatch, capsys):
    monkeypatch.setenv("EVERCAL_TOKEN", token)
    assert main(["serve", str(hall_store), *words.split()]) == 2
    assert message in capsys.readouterr().err
