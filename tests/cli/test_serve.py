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
from typing import Any

import pytest

pytest.importorskip("fastapi")

from evercal.service.client import Client


def started(store: Path, *words: str, **variables: str) -> tuple[subprocess.Popen[str], str]:
    command = [
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
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **variables},
    )
    assert process.stdout is not None
    record = json.loads(process.stdout.readline())
    assert record["store"] == str(store)
    return process, record["url"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_requests_under_way_are_answered_before_the_end(
    number: signal.Signals, hall_store: Path, still_images: Path
) -> None:
    process, url = started(hall_store, EVERCAL_TOKEN="0123456789abcdef")
    with process:
        client, answers = Client(url, "0123456789abcdef"), []

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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--host", "0.0.0.0"], "--host 0.0.0.0: other machines could use the map; give --token"),
        (["--token", "short"], "--token: give at least 16 ASCII characters"),
        (["--port", "99999"], "--port 99999: give 0 to 65535"),
    ],
)
def test_misuse_is_one_line(run: Any, hall_store: Path, words: list[str], message: str) -> None:
    ran = run("serve", hall_store, *words)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err[0].startswith(f"error: {message}")


def test_another_folder_is_refused(run: Any, still_images: Path) -> None:
    ran = run("serve", still_images, "--port", "0")
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert "is not an evercal store" in ran.err[0]


def test_a_missing_package_is_named(
    run: Any, hall_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "evercal.service.server", None)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    ran = run("serve", hall_store)
    assert ran.code == 2
    assert "constraints.txt '.[serve]'" in ran.err[0]
