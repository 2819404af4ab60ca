"""`evercal studio` in a process of its own: its line, its refusals, its end."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("viser")


def test_it_serves_a_page_and_ends_cleanly(tmp_path: Path) -> None:
    words = ["studio", "--virtual", "--port", "0", "--out", str(tmp_path / "s"), "--json"]
    command = [sys.executable, "-m", "evercal", *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stderr is not None
            url = json.loads(process.stdout.readline())["url"]
            with urllib.request.urlopen(url, timeout=60) as page:
                assert b"<html" in page.read()
            process.send_signal(signal.SIGTERM)
            assert process.wait(120) == 0
            assert (process.stdout.read(), process.stderr.read()) == ("", "")
        finally:
            process.kill()
    assert (tmp_path / "s/wrist/camera.json").is_file()
