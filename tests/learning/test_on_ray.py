"""A Ray cluster of two nodes on this machine: the same map, in spite of killed workers."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from evercal.cli.args import Reading
from evercal.cli.learn import read_recording
from evercal.errors import InputError
from evercal.features.encoder import load_encoder
from evercal.learning.task import LearnTask
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.recordings import Recording
from evercal.recordings.addresses import RecordingAt
from evercal.recordings.formats import generic

from .small_maps import QUICK, small_map

pytestmark = [
    pytest.mark.slow(
        "src/evercal/learning", "src/evercal/recordings", "src/evercal/mapping"
    ),
    pytest.mark.filterwarnings("ignore"),  # of Ray: open sockets
]


@pytest.fixture(scope="module")
def folders(
    rooms: tuple[Recording, ...], tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    """Recordings of as few frames as a map needs, each in a folder."""
    root = tmp_path_factory.mktemp("recordings")
    for room in rooms:
        for copy in "12":
            small = replace(room, name=room.name + copy, train=room.train[:16], test=())
            generic.write(root / small.name, small)
    return sorted(root.iterdir())


def kill_workers(stop: threading.Event, killed: list[int]) -> None:
    """Kill three processes that learn, one after the other."""
    while len(killed) < 3 and not stop.wait(0.2):
        for process in Path("/proc").glob("[0-9]*/cmdline"):
            with suppress(OSError):
                if process.read_bytes().startswith(b"ray::_learned"):
                    os.kill(int(process.parent.name), signal.SIGKILL)
                    killed.append(int(process.parent.name))
                    stop.wait(4.0)
                    break


@pytest.fixture
def contents(
    tree: Callable[[Path], dict[str, str]],
) -> Callable[[Path], dict[str, str]]:
    """Checksums of all files of a map but those that state how long it took."""
    varying = ("report.json", "manifest.json")
    return lambda root: {
        k: v for k, v in tree(root).items() if Path(k).name not in varying
    }


def test_the_map_is_the_same_though_workers_and_a_node_go(
    folders: list[Path],
    tmp_path: Path,
    cluster: Any,
    contents: Any,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    turn = small_map(tmp_path / "turn")
    many = small_map(tmp_path / "many")
    for folder in folders:
        turn.learn(folder, options=QUICK)
    # A file of the folder that the program runs in must not become a module of the workers.
    (tmp_path / "cv2.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    stop = threading.Event()
    killed = list[int]()
    killer = threading.Thread(target=kill_workers, args=(stop, killed))
    killer.start()

    third = cluster.add_node(num_cpus=1)

    def learned(_: object) -> None:
        if len(many.scenes) == 1:
            cluster.remove_node(third)
            stop.set()

    try:
        many.learn_many(folders, ray=cluster.address, options=QUICK, on_scene=learned)
    finally:
        stop.set()
        killer.join()
    assert killed
    assert capfd.readouterr().out == ""  # what is printed there is the answer of --json
    assert many.scenes == turn.scenes
    assert contents(tmp_path / "many") == contents(tmp_path / "turn")


def test_bad_recordings_and_kept_results(
    folders: list[Path],
    tmp_path: Path,
    cluster: Any,
    contents: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    address = f"file://{folders[1]}"
    kept = f"file://{tmp_path}/kept"
    with pytest.raises(
        InputError, match=r"1 of 3 .* missing \(file:///nowhere/missing: no such"
    ):
        small_map(tmp_path / "one").learn_many(
            [folders[0], address, "file:///nowhere/missing"],
            ray=cluster.address,
            results=kept,
            options=QUICK,
        )
    monkeypatch.chdir(folders[0].parent)
    reports = small_map(tmp_path / "two").learn_many(
        [folders[0].name, address], results=tmp_path / "kept", options=QUICK
    )
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
    before = MapStore.open(tmp_path / "one").reports()
    assert [report.seconds for report in reports] == [
        report["seconds"] for report in before
    ]
    assert len(list((tmp_path / "kept").iterdir())) == 2


def test_another_way_of_reading_gets_another_result(folders: list[Path]) -> None:
    source = RecordingAt.of(f"file://{folders[0]}")
    contents = MapContents(load_encoder(), 64)
    ways = [partial(read_recording, Reading(every=every)) for every in (1, 1, 2)]
    files = [
        LearnTask(contents, read=way, results="kept").result_of(source) for way in ways
    ]
    assert files[0] == files[1] != files[2]


def test_what_does_not_answer_is_named(folders: list[Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"`ray` 127.0.0.1:1: nothing answers"):
        small_map(tmp_path / "map").learn_many(folders[:1], ray="127.0.0.1:1")
