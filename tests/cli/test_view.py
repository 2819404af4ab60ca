"""`evercal view` in a process of its own: its line, its refusals, its end."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--port", "99999"], "--port 99999: give 0 to 65535"),
        (["gone.json"], "gone.json: calibration file is missing"),
        (["--camera", "c.json"], "--camera: is that of --live, which is missing"),
        (["--live", "gone.mp4"], "gone.mp4: no such folder or video"),
    ],
)
def test_misuse_is_one_line(run: Any, hall_store: Path, words: list[str], message: str) -> None:
    ran = run("view", hall_store, *words)
    assert (ran.code, ran.out) == (2, "")
    assert len(ran.err) == 1
    assert ran.err[0].startswith(f"error: {message}")


def test_another_folder_is_refused(run: Any, still_images: Path) -> None:
    ran = run("view", still_images, "--port", "0")
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert "no manifest.json in it, so it is not a store" in ran.err[0]


def test_networks_are_refused(run: Any, network_store: Path) -> None:
    ran = run("view", network_store, "--port", "0")
    assert (ran.code, len(ran.err)) == (2, 1)
    assert "holds networks of strategy finetune, and this needs a map" in ran.err[0]


def test_a_missing_package_is_named(
    run: Any, hall_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    ran = run("view", hall_store)
    assert (ran.code, len(ran.err)) == (2, 1)
    assert ran.err[0].startswith("error: the page needs viser; in the checkout of evercal, run: ")
    assert ran.err[0].endswith("-c constraints.txt '.[view]'")
