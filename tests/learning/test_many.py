"""Many recordings at once: the same map, in spite of bad recordings and killed workers."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.features.encoder import ENCODER_FILE, load_encoder
from evercal.learning.many import learn_scenes
from evercal.learning.task import LearnTask
from evercal.map import Map
from evercal.mapping.manage import pack_map, remove_scenes, unpack_map
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.recordings import Recording
from evercal.recordings.images import StoredImage

from .small_maps import QUICK, Rooms, small_map


class Deadly(StoredImage):
    """An image whose first readers are killed."""

    def __init__(self, pixels: np.ndarray, marks: Path, times: int):
        self._pixels = pixels
        self._marks = marks
        self._times = times

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


@pytest.fixture(scope="module")
def small(rooms: Rooms) -> Rooms:
    """`rooms` with as few frames as a map needs."""
    return tuple(replace(room, train=room.train[:16], test=()) for room in rooms)


@pytest.fixture(scope="module")
def few(small: Rooms) -> Recording:
    """A recording of too few frames: it is refused at once."""
    return replace(small[0], name="few", train=small[0].train[:3])


def test_the_map_is_that_of_learning_in_turn(small: Rooms, tmp_path: Path) -> None:
    # The first recording of another encoder determines the centroids of all scenes.
    own = tmp_path / "own.onnx"
    # `doc_string` of the model.
    own.write_bytes(ENCODER_FILE.read_bytes() + b"\x32\x03own")
    turn, many = (small_map(tmp_path / name, own) for name in ("turn", "many"))
    for recording in small:
        turn.learn(recording, options=QUICK)
    seen = []
    steps = []
    reports = many.learn_many(
        small,
        workers=2,
        options=QUICK,
        on_scene=lambda report: seen.append(report.scene),
        on_progress=lambda *step: steps.append(step),
    )
    assert [report.scene for report in reports] == seen == ["alpha", "beta", "gamma"]
    assert steps == [("learning", i, 3) for i in range(4)]
    assert reports[0].memory_bytes < reports[1].memory_bytes < reports[2].memory_bytes
    for stage in ("0001-alpha", "0002-beta", "0003-gamma"):
        for name in ("keyframes.safetensors", "scene.json"):
            one, other = (
                tmp_path / root / "stages" / stage / name for root in ("turn", "many")
            )
            assert one.read_bytes() == other.read_bytes()


def test_unusable_recordings_and_killed_workers_do_not_stop_the_others(
    small: Rooms, few: Recording, tmp_path: Path
) -> None:
    once = deadly(small[0], tmp_path / "once", 1)
    always = deadly(small[2], tmp_path / "always", 99)
    opened = small_map(tmp_path / "map")
    items = (tmp_path / "missing", once, few, always, small[1])
    with pytest.raises(
        InputError, match=r"3 of 5 recordings were not learned"
    ) as error:
        opened.learn_many(items, workers=2, options=QUICK)
    assert f"{items[0]}: no such folder" in str(error.value)
    assert re.search(r"few \(.*3 training", str(error.value))
    assert re.search(r"gamma \(.*killed 3 times", str(error.value))
    assert opened.scenes == Map.open(tmp_path / "map").scenes == ("alpha", "beta")
    assert len(list((tmp_path / "once").iterdir())) == 1
    assert len(list((tmp_path / "always").iterdir())) == 3


def test_a_results_file_is_used_if_it_is_that_of_the_recording(
    small: Rooms, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    contents = small_map(tmp_path / "map")._store.contents.empty()
    task = LearnTask(contents, None, QUICK, results=str(tmp_path))
    first, second = (task.result_of(room) for room in small[:2])
    assert first is not None
    assert second is not None
    expected = task.done(0, small[0])
    task.done(1, small[1])
    right = Path(first).read_bytes()
    unpack_map(Path(first), tmp_path / "one")
    empty = MapStore.open(tmp_path / "one")
    remove_scenes(empty, ["alpha"])
    pack_map(tmp_path / "one", tmp_path / "empty.zip")
    smaller = replace(task, memory=4)
    renamed = smaller.result_of(small[0])
    assert renamed is not None
    damaged = {
        "it holds beta": Path(second).read_bytes(),
        "it holds no scene": (tmp_path / "empty.zip").read_bytes(),
        "not a zip archive": right[: len(right) // 2],
        "bytes|zip": right[:-9] + bytes(9),
    }
    for message, content in damaged.items():
        caplog.clear()
        Path(first).write_bytes(content)
        learned = task.done(0, small[0])
        assert learned.scene is not None
        assert learned.scene.name == "alpha"
        assert re.search(
            f"{Path(first).name} is not the result of.*{message}", caplog.text
        )
        caplog.clear()
        assert task.done(0, small[0]).scene is not None
        assert not caplog.text
    Path(first).write_bytes(right)
    Path(renamed).write_bytes(right)
    caplog.clear()
    other = smaller.done(0, small[0])
    assert other.report is not None
    assert f"it was written as '{Path(first).name}'" in caplog.text
    caplog.clear()
    kept = task.done(0, small[0])
    assert not caplog.text
    assert kept.report is not None
    assert expected.report is not None
    assert kept.report.to_dict() == json.loads(json.dumps(expected.report.to_dict()))


def test_names_are_checked_before_anything_is_learned(
    rooms: Rooms, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="alpha"):
        Map.open(tmp_path / "map").learn_many((rooms[0], rooms[1], rooms[0]))
    with pytest.raises(InputError, match="workers 0"):
        Map.open(tmp_path / "map").learn_many(rooms[:2], workers=0)
    assert not (tmp_path / "map/manifest.json").exists()


def test_a_worker_killed_while_the_caller_writes_a_scene_is_replaced(
    small: Rooms, few: Recording
) -> None:
    task = LearnTask(MapContents(load_encoder(), 64), options=QUICK)
    outcomes = learn_scenes(task, (few, small[0], few), 2)
    first = next(iter(outcomes))
    for child in children_of(os.getpid()):
        if is_worker(child):
            os.kill(child, signal.SIGKILL)
    time.sleep(2.0)  # until the pool has noticed
    rest = list(outcomes)
    learned = {outcome.number: outcome.scene is not None for outcome in (first, *rest)}
    assert learned == {0: False, 1: True, 2: False}


PARENT = """
import sys
from evercal.map import Map

if __name__ == "__main__":
    Map.open(sys.argv[1]).learn_many(sys.argv[2:], workers=2)
"""


def test_workers_end_with_their_parent(rooms: Rooms, tmp_path: Path) -> None:
    from evercal.recordings.formats import generic

    for recording in rooms[:2]:
        generic.write(tmp_path / recording.name, recording)
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    words = [tmp_path / "map", *(tmp_path / recording.name for recording in rooms[:2])]
    with subprocess.Popen([sys.executable, script, *map(str, words)]) as parent:
        children = wait_for(
            lambda: [c for c in children_of(parent.pid) if is_worker(c)]
        )
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


def test_stopping_early_ends_the_workers(small: Rooms, few: Recording) -> None:
    task = LearnTask(MapContents(load_encoder(), 64), options=QUICK)
    outcomes = learn_scenes(task, (few, *small), 2)
    next(iter(outcomes))
    outcomes.close()  # pyright: ignore[reportAttributeAccessIssue]
    wait_for(lambda: not [c for c in children_of(os.getpid()) if is_worker(c)])
