"""Many recordings at once: the same map, in spite of bad recordings and killed workers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evercal.errors import InputError
from evercal.features.encoder import load_encoder
from evercal.features.weights_file import network_bytes
from evercal.learning.many import LearnTask, learn_scenes
from evercal.map import Map
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.recordings import Recording
from evercal.recordings.images import StoredImage
from evercal.storage.atomic import write_bytes


class Deadly(StoredImage):
    """An image whose first readers are killed."""

    def __init__(self, pixels: np.ndarray, marks: Path, times: int):
        self._pixels, self._marks, self._times = pixels, marks, times

    def read(self) -> np.ndarray:
        deaths = len(list(self._marks.iterdir()))
        if deaths < self._times:
            (self._marks / f"{deaths}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return self._pixels


def deadly(recording: Recording, marks: Path, times: int) -> Recording:
    """The recording with an image that kills its reader."""
    marks.mkdir()
    first = recording.train[0]
    image = Deadly(first.read_image(), marks, times)
    return replace(recording, train=(replace(first, image=image), *recording.train[1:]))


def small_map(root: Path, encoder: Path | None = None) -> Map:
    """A new map that encodes images at 64 pixels, which is fast."""
    return Map(MapStore.create(root, encoder, short_side=64))


def small_contents() -> MapContents:
    return MapContents(load_encoder(), 64)


@pytest.fixture(scope="module")
def short(rooms: tuple[Recording, ...]) -> tuple[Recording, Recording]:
    """The first 18 frames of two rooms."""
    alpha, beta = (replace(room, train=room.train[:18]) for room in rooms[:2])
    return alpha, beta


@pytest.fixture(scope="module")
def turn(short: tuple[Recording, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map that learned one room after the other."""
    root = tmp_path_factory.mktemp("turn") / "map"
    opened = small_map(root)
    for recording in short:
        opened.learn(recording)
    return root


def assert_same(one: Path, other: Path) -> None:
    """Both rooms are the same in both maps."""
    for name in ("keyframes.safetensors", "scene.json"):
        for stage in ("stages/0001-alpha", "stages/0002-beta"):
            assert (one / stage / name).read_bytes() == (other / stage / name).read_bytes()


def test_the_map_is_that_of_learning_in_turn(
    short: tuple[Recording, ...], turn: Path, tmp_path: Path
) -> None:
    seen, steps = [], []
    reports = small_map(tmp_path / "many").learn_many(
        short,
        workers=2,
        on_scene=lambda report: seen.append(report.scene),
        on_progress=lambda *step: steps.append(step),
    )
    assert [report.scene for report in reports] == seen == ["alpha", "beta"]
    assert steps == [("learning", i, 2) for i in range(3)]
    assert reports[0].memory_bytes < reports[1].memory_bytes
    assert_same(tmp_path / "many", turn)


def test_scenes_of_another_encoder_share_their_centroids(
    short: tuple[Recording, ...], tmp_path: Path
) -> None:
    encoder, own = load_encoder(), tmp_path / "own.safetensors"
    with torch.no_grad():
        next(encoder.parameters()).mul_(1.001)  # pyright: ignore[reportAttributeAccessIssue]
    write_bytes(own, network_bytes(encoder, "encoder"))
    in_turn, many = (small_map(tmp_path / name, own) for name in ("turn", "many"))
    for recording in short:
        in_turn.learn(recording)
    many.learn_many(short, workers=1)
    assert_same(tmp_path / "turn", tmp_path / "many")


def test_names_are_checked_before_anything_is_learned(
    rooms: tuple[Recording, ...], tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="alpha"):
        Map.open(tmp_path / "map").learn_many((rooms[0], rooms[1], rooms[0]))
    with pytest.raises(InputError, match="workers 0"):
        Map.open(tmp_path / "map").learn_many(rooms[:2], workers=0)
    assert not (tmp_path / "map/manifest.json").exists()


def test_a_killed_worker_is_replaced(
    short: tuple[Recording, ...], turn: Path, tmp_path: Path
) -> None:
    once = deadly(short[0], tmp_path / "marks", 1)
    reports = small_map(tmp_path / "map").learn_many((once, short[1]), workers=2)
    assert [report.scene for report in reports] == ["alpha", "beta"]
    assert len(list((tmp_path / "marks").iterdir())) == 1
    assert_same(tmp_path / "map", turn)


def test_a_worker_killed_while_the_caller_writes_a_scene_is_replaced(
    short: tuple[Recording, ...],
) -> None:
    many = [replace(short[0], name=f"{i}") for i in range(3)]
    outcomes = learn_scenes(LearnTask(small_contents()), many, 2)
    first = next(iter(outcomes))
    for child in children_of(os.getpid()):
        if is_worker(child):
            os.kill(child, signal.SIGKILL)
    time.sleep(2.0)  # until the pool has noticed
    rest = list(outcomes)
    assert sorted(outcome.number for outcome in (first, *rest)) == [0, 1, 2]
    assert all(outcome.scene is not None for outcome in (first, *rest))


def test_recordings_that_fail_do_not_stop_the_others(
    short: tuple[Recording, ...], tmp_path: Path
) -> None:
    always = deadly(short[0], tmp_path / "marks", 99)
    few = replace(short[0], name="few", train=short[0].train[:3])
    opened = small_map(tmp_path / "map")
    message = r"2 of 3 recordings were not learned: alpha .*killed 3 times.*; few \(.*3 "
    with pytest.raises(InputError, match=message):
        opened.learn_many((always, few, short[1]), workers=2)
    assert opened.scenes == Map.open(tmp_path / "map").scenes == ("beta",)
    assert len(list((tmp_path / "marks").iterdir())) == 3


PARENT = """
import sys
from evercal.map import Map

if __name__ == "__main__":
    Map.open(sys.argv[1]).learn_many(sys.argv[2:], workers=2)
"""


def test_workers_end_with_their_parent(rooms: tuple[Recording, ...], tmp_path: Path) -> None:
    from evercal.recordings.formats import generic

    for recording in rooms[:2]:
        generic.write(tmp_path / recording.name, recording)
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    words = [tmp_path / "map", *(tmp_path / recording.name for recording in rooms[:2])]
    with subprocess.Popen([sys.executable, script, *map(str, words)]) as parent:
        children = wait_for(lambda: [c for c in children_of(parent.pid) if is_worker(c)])
        parent.kill()
    wait_for(lambda: not any(Path(f"/proc/{child}").exists() for child in children))


def children_of(process: int) -> list[int]:
    """Processes that another one has started, also from its threads."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(status.read_text().rpartition(")")[2].split()[1]) == process:
                found.append(int(status.parent.name))
    return found


def is_worker(process: int) -> bool:
    """Whether a process is one of a pool, and not the tracker of its resources."""
    try:
        return b"spawn_main" in Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False


def wait_for(condition):
    """The first true value of a condition."""
    deadline = time.monotonic() + 60
    while not (value := condition()):
        assert time.monotonic() < deadline, "it never became true"
        time.sleep(0.05)
    return value


def test_stopping_early_ends_the_workers(short: tuple[Recording, ...]) -> None:
    many = [replace(short[0], name=f"{i}") for i in range(4)]
    outcomes = learn_scenes(LearnTask(small_contents()), many, 1)
    assert next(iter(outcomes)).scene is not None
    outcomes.close()  # pyright: ignore[reportAttributeAccessIssue]
    wait_for(lambda: not [c for c in children_of(os.getpid()) if is_worker(c)])
