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
from pathlib import Path
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


@contextmanager
def served(*words: object) -> Iterator[dict[str, Any]]:
    """What `evercal serve --json` prints; it ends without an error."""
    command = [sys.executable, "-m", "evercal", "serve", *map(str, words), "--json"]
    environment = {**os.environ, "EVERCAL_TOKEN": TOKEN}
    with subprocess.Popen(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
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


def test_replicas_answer_as_one_process(
    serve: Any, copy: Path, image: Path, cluster: Any, tmp_path: Path
) -> None:
    parts = [("image", (image.name, image.read_bytes()))]
    with serve(copy, token=TOKEN) as one:
        header = {"Authorization": f"Bearer {TOKEN}"}
        expected = one.ask("POST", "/localize", parts, headers=header).json
    words = ("--ray", cluster.address, "--replicas", 2, "--port", free_port())
    with served(copy, *words) as ready:
        client = Client(ready["url"], TOKEN)
        assert client.scenes == ("hall",)
        for _ in range(4):
            estimate = client.localize(image)
            assert estimate.base_from_camera is not None
            pose = expected["base_from_camera"]
            assert (
                estimate.base_from_camera.translation_m.tolist()
                == pose["translation_m"]
            )
            assert estimate.covariance is not None
            assert estimate.covariance.tolist() == expected["covariance"]
        with pytest.raises(InputError, match="Authorization: Bearer TOKEN"):
            _ = Client(ready["url"]).scenes
        large = tmp_path / "large.png"
        large.write_bytes(b"\0" * 129_000_000)
        with pytest.raises(InputError, match="body of 129000"):
            client.localize(large)
        refused = subprocess.run(
            [sys.executable, "-m", "evercal", "serve", copy, *map(str, words)],
            env={**os.environ, "EVERCAL_TOKEN": TOKEN},
            capture_output=True,
            text=True,
        )
        assert refused.returncode == 2
        assert "serves a map already" in refused.stderr
        Map.open(copy).rename("hall", "lobby")
        until = time.monotonic() + 20
        while {client.scenes for _ in range(4)} != {("lobby",)}:
            assert time.monotonic() < until
            time.sleep(0.1)
        assert client.localize(image).scene == "lobby"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--ray", "127.0.0.1:1"), "--ray 127.0.0.1:1: nothing answers"),
        (("--ray", "auto", "--replicas", "0"), "--replicas 0: give a number >= 1"),
        (("--ray", "auto", "--port", "0"), "--port 0: give 1 to 65535"),
        (("--replicas", "2"), "--replicas 2: give --ray, too"),
    ],
)
def test_refusals(
    words: tuple[str, ...],
    message: str,
    hall_store: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("EVERCAL_TOKEN", TOKEN)
    assert main(["serve", str(hall_store), *words]) == 2
    assert message in capsys.readouterr().err


def test_a_cluster_needs_a_token(
    hall_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", str(hall_store), "--ray", "auto"]) == 2
    assert (
        "--ray: other machines could use the map; give --token-file"
        in capsys.readouterr().err
    )
