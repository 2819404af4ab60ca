"""`evercal view` in a process of its own: its line, its refusals, its end."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("viser")


def test_it_prints_the_address_and_ends_cleanly(hall_store: Path) -> None:
    command = [sys.executable, "-m", "evercal", "view", str(hall_store), "--port", "0", "--json"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stderr is not None
            url = json.loads(process.stdout.readline())["url"]
            assert url.startswith("http://127.0.0.1:")
            with urllib.request.urlopen(url, timeout=60) as page:
                assert b"<html" in page.read()
            process.send_signal(signal.SIGTERM)
            assert process.wait(120) == 0
            assert (process.stdout.read(), process.stderr.read()) == ("", "")
        finally:
            process.kill()
