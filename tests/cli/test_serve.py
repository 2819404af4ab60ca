"""`evercal serve` in a process of its own: its line, its refusals, its end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("fastapi")

from evercal.errors import InputError
from evercal.service.client import Client


def started(
    store: Path, *words: str, **variables: str
) -> tuple[subprocess.Popen[str], str]:
    serve = [
        sys.executable,
        "-m",
        "evercal",
        "serve",
        str(store),
        "--port",
        "0",
        "--json",
        *words,
    ]
    pipe = subprocess.PIPE
    env = {**os.environ, **variables}
    process = subprocess.Popen(
        serve,
        stdout=pipe,
        stderr=pipe,
        text=True,
        env=env,
        # A shell's background job ignores Ctrl-C, and so would the service.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    record = json.loads(process.stdout.readline())
    assert record["store"] == str(store)
    return process, record["url"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_requests_under_way_are_answered_before_the_end(
    number, hall_store, still_images
):
    process, url = started(hall_store, EVERCAL_TOKEN="0123456789abcdef")
    with process:
        client = Client(url, "0123456789abcdef")
        answers = []

        def calibrate() -> None:
            answers.append(client.calibrate(still_images))

        assert client.scenes == ("hall",)
        asking = threading.Thread(target=calibrate)
        asking.start()
        time.sleep(0.3)
        process.send_signal(number)
        asking.join(60)
        assert process.wait(60) == (0 if number == signal.SIGTERM else 130)
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()
    assert len(answers[0].images) == 20


def test_the_token_comes_from_a_file(hall_store, tmp_path):
    (tmp_path / "token").write_text("0123456789abcdef\n")
    process, url = started(hall_store, "--token-file", str(tmp_path / "token"))
    with process:
        assert Client(url, "0123456789abcdef").scenes == ("hall",)
        with pytest.raises(InputError, match="Bearer TOKEN"):
            _ = Client(url).scenes
        process.terminate()
