"""`learn_networks`: its report, what it refuses, and how an interrupted call continues."""

from __future__ import annotations

import json
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evercal.continual import threshold
from evercal.continual.learning import stage_rows
from evercal.continual.learning.learn_scene import MapProgress, NetworkLearnOptions, learn_networks
from evercal.continual.learning.stage import Encoding, StageOptions
from evercal.continual.localizer import HybridLocalizer, open_networks
from evercal.continual.networks.trainer import Progress
from evercal.continual.store import Checkpoint, NetworkStore, head_bytes
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.learning.scene import LearnReport
from evercal.recordings import generic

from ..stages import Rooms, Tree


def noise(*_: object) -> list[np.ndarray]:
    """Negative images that need no rendering."""
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (48, 64, 3)).astype(np.uint8) for _ in range(4)]


@pytest.fixture(scope="module")
def options(quick: StageOptions) -> Iterator[NetworkLearnOptions]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threshold, "_negative_views", noise)
        yield NetworkLearnOptions(stage=quick, short_side=48)


@dataclass
class Learned:
    """A store after two scenes."""

    root: Path
    reports: list[LearnReport]
    events: list[object]


@pytest.fixture(scope="module")
def learned(
    options: NetworkLearnOptions, rooms: Rooms, tmp_path_factory: pytest.TempPathFactory
) -> Learned:
    root, events = tmp_path_factory.mktemp("learned") / "store", []
    reports = [learn_networks(root, room, options, events.append) for room in rooms[:2]]
    return Learned(root, reports, events)


@pytest.fixture
def untimed(tree: Tree) -> Tree:
    """Checksums of a store without the files that contain durations."""
    timed = ("manifest.json", "report.json")
    return lambda root: {k: sha for k, sha in tree(root).items() if not k.endswith(timed)}


def test_reports_describe_the_store(learned: Learned) -> None:
    store = NetworkStore.open(learned.root)
    contents = store.contents
    assert [record.name for record in contents.scenes] == ["alpha", "beta"]
    assert [json.loads(json.dumps(asdict(r))) for r in learned.reports] == store.reports()
    for report, record, keyframes in zip(
        learned.reports, contents.scenes, contents.keyframes, strict=True
    ):
        assert keyframes is not None
        assert report.scene == record.name
        assert report.frames_kept == len(keyframes) <= 0.1 * 30
        assert report.train_frames == record.train_frames
        assert report.train_frames + report.held_out_frames == 30
        assert report.iterations == 8
        assert report.min_support == record.inlier_threshold
        assert 0 < report.seconds < 600
        assert (report.landmarks, report.adjusted) == (0, None)
    first, last = learned.reports
    assert first.memory_bytes < last.memory_bytes == contents.memory_bytes
    assert last.head_bytes == head_bytes(contents.heads[0])
    assert {type(event) for event in learned.events} == {Encoding, Checkpoint, Progress}
    assert not (learned.root / "learning").exists()


def test_hybrid_also_builds_a_map(
    rooms: Rooms, options: NetworkLearnOptions, tmp_path: Path
) -> None:
    root, events = tmp_path / "store", []
    hybrid = replace(options, strategy="evercal_hybrid")
    report = learn_networks(root, rooms[0], hybrid, events.append)
    assert MapProgress in {type(event) for event in events}
    record = NetworkStore.open(root).contents.scenes[0]
    assert record.map is not None
    assert report.landmarks == record.map.landmarks > 0
    assert report.min_support == record.map.min_support > 0
    assert report.adjusted is not None
    assert report.iterations == 8
    assert isinstance(open_networks(root, "cpu"), HybridLocalizer)


def test_bad_input_is_refused_and_leaves_the_store_unchanged(
    learned: Learned, rooms: Rooms, options: NetworkLearnOptions, tmp_path: Path, tree: Tree
) -> None:
    before, gamma = tree(learned.root), rooms[2]
    gripper = [
        replace(f, base_from_camera=None, base_from_gripper=f.base_from_camera) for f in gamma.train
    ]
    few = replace(gamma, train=gamma.train[:15])
    for recording, change, message in (
        (replace(gamma, name="alpha"), {}, r"'alpha'.*--name"),
        (gamma, {"strategy": "finetune"}, r"'finetune'.*'evercal_network'"),
        (gamma, {"strategy": "nonsense"}, "'nonsense'"),
        (gamma, {"strategy": "joint"}, r"'joint'.*evercal bench"),
        (gamma, {"encoder": Path("encoder.safetensors")}, "keeps the encoder"),
        (gamma, {"stage": None, "memory": "auto"}, "memory auto"),
        (gamma, {"stage": None, "centres": 0}, "--centres 0"),
        (gamma, {"centres": 5}, "--centres 5: .* made with 3"),
        (replace(gamma, train=tuple(gripper)), {}, "only gripper poses"),
        (few, {}, "'gamma': 15 training frames"),
    ):
        with pytest.raises(InputError, match=message):
            learn_networks(learned.root, recording, replace(options, **change))
    assert tree(learned.root) == before
    with pytest.raises(InputError, match="15 training frames"):
        learn_networks(tmp_path / "new", few, options)
    assert not (tmp_path / "new").exists()
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="not an evercal store"):
        learn_networks(tmp_path, gamma, options)
    assert (tmp_path / "thesis.tex").read_text() == "x"


class Interrupted(Exception):
    """Raised within a call to end it."""


def stop_at(kind: str, number: int) -> Callable[[object], None]:
    """Interrupt at the n-th checkpoint of `rows` or of the `trainer`."""
    count = [0]

    def watch(event: object) -> None:
        if isinstance(event, Checkpoint) and getattr(event, kind):
            count[0] += 1
            if count[0] == number:
                raise Interrupted

    return watch


def steps_of(events: list[object]) -> list[int]:
    return [event.step for event in events if isinstance(event, Progress)]


@pytest.mark.parametrize(("kind", "number"), [("rows", 1), ("rows", 3), ("trainer", 5)])
def test_interrupted_call_continues_where_it_stopped(
    kind: str,
    number: int,
    learned: Learned,
    rooms: Rooms,
    options: NetworkLearnOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    untimed: Tree,
) -> None:
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
    store = tmp_path / "store"
    for room in rooms[:2]:
        with pytest.raises(Interrupted):
            learn_networks(store, room, options, stop_at(kind, number))
        events: list[object] = []
        learn_networks(store, room, options, events.append)
        views = [event.done for event in events if isinstance(event, Encoding)]
        assert kind == "trainer" or views[0] > 8
        assert steps_of(events)[0] == (number + 1 if kind == "trainer" else 1)
    assert untimed(store) == untimed(learned.root)


def test_er_interrupted_between_encoding_and_training(
    rooms: Rooms, options: NetworkLearnOptions, tmp_path: Path, untimed: Tree
) -> None:
    er, whole, store = replace(options, strategy="er"), tmp_path / "whole", tmp_path / "store"

    def stop(event: object) -> None:
        if isinstance(event, Progress):
            raise Interrupted

    for room in rooms[:2]:
        learn_networks(whole, room, er)
        with pytest.raises(Interrupted):
            learn_networks(store, room, er, stop)
        events: list[object] = []
        learn_networks(store, room, er, events.append)
        # All views of the new scene are restored from the checkpoint; only replayed ones follow.
        views = {event.total for event in events if isinstance(event, Encoding)}
        assert views == (set() if room is rooms[0] else {4})
        assert steps_of(events) == list(range(1, 9))
    assert untimed(store) == untimed(whole)


def test_second_writer_is_refused(
    learned: Learned,
    rooms: Rooms,
    options: NetworkLearnOptions,
    tmp_path: Path,
    untimed: Tree,
) -> None:
    store, messages = tmp_path / "store", []

    def intrude(_: object) -> None:
        if not messages:
            with pytest.raises(InputError, match="another process") as refusal:
                learn_networks(store, rooms[1], options)
            messages.append(str(refusal.value))

    learn_networks(store, rooms[0], options, intrude)
    assert len(messages) == 1
    learn_networks(store, rooms[1], options)
    assert untimed(store) == untimed(learned.root)


def test_other_stages_are_not_resumed(
    learned: Learned,
    rooms: Rooms,
    options: NetworkLearnOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    untimed: Tree,
) -> None:
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
    store, alpha = tmp_path / "store", rooms[0]
    first, motion = alpha.train[0], SE3.exp(np.array([0.01, 0, 0, 0, 0, 0]))
    assert first.base_from_camera is not None
    moved = replace(first, base_from_camera=motion @ first.base_from_camera)
    assert options.stage is not None
    for recording, other in (
        (replace(alpha, name="other"), options),
        (replace(alpha, train=(moved, *alpha.train[1:])), options),
        (alpha, replace(options, stage=replace(options.stage, seed=3))),
        (alpha, replace(options, short_side=40)),
    ):
        with pytest.raises(Interrupted):
            learn_networks(store, recording, other, stop_at("trainer", 2))
        views: list[int] = []
        stop = stop_at("rows", 1)

        def watch(
            event: object, views: list[int] = views, stop: Callable[[object], None] = stop
        ) -> None:
            views += [event.done] if isinstance(event, Encoding) else []
            stop(event)

        with pytest.raises(Interrupted):
            learn_networks(store, alpha, options, watch)
        assert views[0] <= 8
    for room in rooms[:2]:
        learn_networks(store, room, options)
    assert untimed(store) == untimed(learned.root)


CHILD = """
import pickle, sys, time
from pathlib import Path
from evercal.continual.learning import stage_rows
from evercal.continual.learning.learn_scene import learn_networks
from evercal.continual.networks.trainer import Progress
from evercal.recordings import generic
def wait(event):
    if isinstance(event, Progress) and event.step == 6:
        print("now", flush=True)
        time.sleep(600)
stage_rows.CHECKPOINT_SECONDS = 0.0
store, recording, options = map(Path, sys.argv[1:])
learn_networks(store, generic.load(recording), pickle.loads(options.read_bytes()), wait)
"""


def test_kill_nine(
    learned: Learned,
    rooms: Rooms,
    options: NetworkLearnOptions,
    tmp_path: Path,
    tree: Tree,
) -> None:
    generic.write(tmp_path / "beta", rooms[1])
    beta, store = generic.load(tmp_path / "beta"), tmp_path / "store"
    learn_networks(store, rooms[0], options)
    image = rooms[0].train[0].read_image()
    before, expected = tree(store), open_networks(store, "cpu").localize(image)
    (tmp_path / "options").write_bytes(pickle.dumps(options))
    paths = [str(path) for path in (store, tmp_path / "beta", tmp_path / "options")]
    command = [sys.executable, "-c", CHILD, *paths]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "now\n"
        child.send_signal(signal.SIGKILL)
        assert child.wait(60) == -signal.SIGKILL
    after = tree(store)
    assert {name: after.get(name) for name in before} == before
    assert all(name.startswith("learning/") for name in after.keys() - before.keys())
    localizer = open_networks(store, "cpu")
    assert localizer.scenes == ("alpha",)
    estimate = localizer.localize(image)
    assert (estimate.status, estimate.inliers) == (expected.status, expected.inliers)
    events: list[object] = []
    learn_networks(store, beta, options, events.append)
    assert steps_of(events) == [6, 7, 8]
    heads = [NetworkStore.open(root).contents.heads[0] for root in (store, learned.root)]
    for name, value in heads[0].state_dict().items():
        torch.testing.assert_close(value, heads[1].state_dict()[name], rtol=0, atol=2e-3)
