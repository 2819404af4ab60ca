"""Processes that are killed several times on the way have the results of one that was not."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
import pytest

from evercal.continual.benchmark.results import KEY, read
from evercal.continual.learning.checkpoint import CHECKPOINT, CURVE
from evercal.recordings import generic

from ..stages import Tree

if TYPE_CHECKING:
    from evercal.recordings import Recording

PROGRAM = """
import sys
import numpy as np
from evercal.cli import main
from evercal.continual import threshold
from evercal.continual.learning import checkpoint

checkpoint.EVERY_S = -1.0
noise = np.random.default_rng(0).integers(0, 256, (2, 240, 320, 3)).astype(np.uint8)
threshold._negative_views = lambda *_: noise
sys.exit(main(sys.argv[1:]))
"""
SMALL = ("--preset", "bench", "--steps", "60", "--batch", "64")


@pytest.fixture(scope="module")
def folders(
    arcs: tuple[Recording, Recording], tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    """Two recordings of 20 training frames."""
    root = tmp_path_factory.mktemp("rooms")
    for scene in arcs:
        few = replace(scene, train=scene.train[:20], test=scene.test[:2])
        generic.write(root / scene.name, few)
    return [root / scene.name for scene in arcs]


def started(*words: object) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", PROGRAM, *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def run(*words: object) -> None:
    assert started(*words).wait() == 0


def run_killed_at(patterns: Sequence[Path], *words: object) -> None:
    """Kill a process as soon as a file exists, for one file after the other; then let it end."""
    for pattern in patterns:
        process = started(*words)
        while not any(pattern.parent.glob(pattern.name)):
            assert process.poll() is None, f"ended without {pattern}"
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.wait()
    run(*words)


def test_learn(folders: list[Path], tmp_path: Path, tree: Tree) -> None:
    stores = [tmp_path / name / "store" for name in ("whole", "killed")]
    for store in stores:
        run("learn", store, folders[0], "--strategy", "mir", *SMALL)
    words = (folders[1], *SMALL)
    run("learn", stores[0], *words)
    unfinished = stores[1].with_name(".store.learning")
    encoding = unfinished / "*" / "*.npy"
    killed = [encoding.parent, unfinished / CHECKPOINT, unfinished / CURVE]
    run_killed_at(killed, "learn", stores[1], *words)
    assert not unfinished.exists()
    whole, other = map(tree, stores)
    assert whole.keys() == other.keys()
    apart = {name for name in whole if whole[name] != other[name]}
    assert apart == {
        "manifest.json",
        "stages/0001-one/report.json",
        "stages/0002-two/report.json",
    }
    reports = []
    for store in stores:
        report = json.loads((store / "stages/0002-two/report.json").read_text())
        assert report.pop("seconds") > 0
        reports.append(report)
    assert reports[0] == reports[1]
    report = reports[0]
    assert (report["preset"], report["seed"], report["iterations"]) == ("bench", 0, 60)
    assert report["strategy"]["name"] == "mir"
    assert report["strategy"]["method"]["weight"] > 0
    curve = pd.read_csv(stores[1] / "stages/0002-two" / CURVE)
    assert list(curve["step"]) == list(range(1, 61))
    last = curve.iloc[-1]
    assert (last["loss"], last["inlier_share"]) == (
        report["loss"],
        report["inlier_share"],
    )


def test_bench(folders: list[Path], tmp_path: Path) -> None:
    def words(out: Path) -> tuple[object, ...]:
        names = ("--strategies", "er,joint", "--seeds", "0")
        return "bench", "custom", *folders, *names, *SMALL, "--out", out

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run(*words(whole))
    curves = ("first-one-0-one", "er-0-two", "joint-0")
    checkpoints = [killed / "training" / name / CHECKPOINT for name in curves]
    run_killed_at(checkpoints, *words(killed))
    tables = []
    for out in (whole, killed):
        table = read(out).drop(columns="seconds")
        tables.append(table.sort_values(KEY, ignore_index=True))
        written = {path.parent.name: path.name for path in out.glob("training/*/*.*")}
        assert written == dict.fromkeys(curves, CURVE)
    pd.testing.assert_frame_equal(*tables)
    for name in curves:
        assert (whole / "training" / name / CURVE).read_bytes() == (
            killed / "training" / name / CURVE
        ).read_bytes()
