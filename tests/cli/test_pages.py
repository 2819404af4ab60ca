"""`evercal view` and `evercal studio` in processes of their own: the page, the line, the end."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import urllib.request

import pytest

pytest.importorskip("viser")


@pytest.mark.parametrize("verb", ["view", "studio"])
def test_it_serves_a_page_and_ends_cleanly(verb, hall_store, tmp_path):
    words = {"view": [hall_store], "studio": ["--virtual", "--out", tmp_path / "s"]}[
        verb
    ]
    command = [
        sys.executable,
        "-m",
        "evercal",
        verb,
        *map(str, words),
        "--port",
        "0",
        "--json",
    ]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stderr is not None
            url = json.loads(process.stdout.readline())["url"]
            assert url.startswith("http://127.0.0.1:")
            page = f"{url}?light"  # the address itself chooses by the colours of the system
            with urllib.request.urlopen(page, timeout=60) as answer:
                assert b"<html" in answer.read()
            process.send_signal(signal.SIGTERM)
            assert process.wait(120) == 0
            assert (process.stdout.read(), process.stderr.read()) == ("", "")
        finally:
            process.kill()
    assert verb == "view" or (tmp_path / "s").is_dir()
