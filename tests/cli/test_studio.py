"""`evercal studio` in a process of its own: its line, its refusals, its end."""

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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "no --camera SOURCE given"),
        (["--camera", "0"], "no --poses FILE given"),
        (["--camera", "GONE", "--poses", "p.csv"], "GONE: no such folder or video"),
        (["--camera", "DIR", "--poses", "p.csv"], "no --intrinsics FILE given"),
        (["--virtual", "--camera", "0"], "--camera: the virtual cell has its own"),
        (["--virtual", "--most-age", "5"], "--most-age: the virtual cell has its own"),
        (["--virtual", "--pose-convention", "ur"], "--pose-convention: the virtual cell has"),
        (["--virtual", "--fixed-intrinsics", "c.json"], "--fixed-intrinsics: is of --fixed"),
        (["--virtual", "--seed", "9000"], "seed 9000"),
        (["--virtual", "--port", "99999"], "--port 99999: give 0 to 65535"),
    ],
)
def test_misuse_is_one_line(
    run: Any, tmp_path: Path, still_images: Path, words: list[str], message: str
) -> None:
    given = [str(still_images) if word == "DIR" else word for word in words]
    ran = run("studio", *given, "--out", tmp_path / "studio")
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert ran.err[0].startswith(f"error: {message}")


def test_a_missing_package_is_named(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    ran = run("studio", "--virtual", "--out", tmp_path / "studio")
    assert (ran.code, len(ran.err)) == (2, 1)
    assert ran.err[0].startswith("error: the page needs viser; in the checkout of evercal, run: ")
    assert ran.err[0].endswith("-c constraints.txt '.[view]'")
