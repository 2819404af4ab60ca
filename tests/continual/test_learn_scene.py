"""`learn_scene`: what is held out, what is refused, and going on after a kill."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from evercal.mapping.scene_maps import Alignment
from evercal.mapping.stage_files import head_bytes

from evercal.continual import stage_rows
from evercal.continual.learn_scene import LearnOptions, LearnReport, learn_scene, validation_split
from evercal.continual.networks.trainer import Progress
from evercal.continual.stage import Encoding, StageOptions
from evercal.continual.strategies import STRATEGIES
from evercal.errors import InputError
from evercal.geometry.se3 import SE3
from evercal.localization import acceptance
from evercal.localization.acceptance import MAX_SUPPORT, MIN_SUPPORT
from evercal.localization.localizer import Localizer
from evercal.mapping.build import Mapping
from evercal.mapping.store import Checkpoint, Store
from evercal.recordings import generic
from evercal.recordings.frame import Recording
from evercal.storage import MANIFEST, write_manifest

Rooms = tuple[Recording, Recording, Recording]
Tree = Callable[[Path], dict[str, str]]


def noise(*_: object) -> list[np.ndarray]:
    """Quick negative images, in place of four rooms that must be made first."""
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (48, 64, 3)).astype(np.uint8) for _ in range(4)]


@pytest.fixture(scope="module")
def options(quick: StageOptions) -> Iterator[LearnOptions]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(acceptance, "_negative_images", noise)
        yield LearnOptions(quick, STRATEGIES["evercal_network"], short_side=48)


@dataclass
class Taught:
    """A store after two scenes."""

    root: Path
    reports: list[LearnReport]
    events: list[object]


@pytest.fixture(scope="module")
def taught(options: LearnOptions, rooms: Rooms, tmp_path_factory: pytest.TempPathFactory) -> Taught:
    root, events = tmp_path_factory.mktemp("taught") / "store", []
    reports = [learn_scene(root, room, options, events.append) for room in rooms[:2]]
    return Taught(root, reports, events)


@pytest.fixture
def learned(tree: Tree) -> Tree:
    """Lists a store without what tells of the time that was needed."""
    timed = ("manifest.json", "report.json")
    return lambda root: {k: sha for k, sha in tree(root).items() if not k.endswith(timed)}


@pytest.mark.parametrize("count", [16, 17, 30, 99, 100, 101, 250, 1000])
def test_held_out_frames_are_blocks_of_four(count: int, rooms: Rooms) -> None:
    some = rooms[0].train[0]
    frames = [replace(some, name=f"{i:06d}") for i in range(count)]
    kept, aside = validation_split(frames)
    assert sorted([*kept, *aside], key=lambda f: f.name) == frames
    numbers = [int(frame.name) for frame in aside]
    assert numbers == sorted(numbers)
    assert [f.name for f in kept] == sorted(f.name for f in kept)
    assert len(numbers) >= 4
    starts = [n for n in numbers if n - 1 not in numbers]
    for start in starts:
        assert [n in numbers for n in range(start, start + 5)] == [True] * 4 + [False]
    # A block lies between learned frames, so that its views are new but the place is known.
    assert 0 not in numbers
    assert count - 1 not in numbers


@pytest.mark.parametrize("count", [16, 30, 100, 150, 300, 1000])
def test_held_out_frames_are_four_in_a_hundred(count: int, rooms: Rooms) -> None:
    _, aside = validation_split([rooms[0].train[0]] * count)
    assert len(aside) == 4 * max(1, (count + 49) // 100)


def test_a_report_says_what_is_in_the_store(taught: Taught) -> None:
    store = Store.open(taught.root)
    maps = store.maps
    assert [record.name for record in maps.scenes] == ["alpha", "beta"]
    for i, report in enumerate(taught.reports):
        path = taught.root / "stages" / store.stages[i] / "report.json"
        assert json.loads(path.read_text()) == asdict(report)
        keyframes = maps.keyframes[i]
        assert keyframes is not None
        assert report.scene == maps.scenes[i].name
        assert report.frames_kept == len(keyframes.images)
        assert report.train_frames == maps.scenes[i].train_frames
        assert report.train_frames + report.held_out_frames == 30
        assert report.frames_kept <= 0.1 * 30
        assert report.iterations == 8
        assert report.inlier_threshold == maps.scenes[i].inlier_threshold
        assert not report.resumed
        assert 0 < report.seconds < 600
        assert (report.landmarks, report.adjusted) == (0, None)
    last = taught.reports[-1]
    assert last.memory_bytes == sum(m.bytes for m in maps.keyframes if m is not None)
    assert taught.reports[0].memory_bytes < last.memory_bytes
    assert last.head_bytes == head_bytes(maps.heads[0])
    kinds = {type(event) for event in taught.events}
    assert kinds == {Encoding, Checkpoint, Progress}
    assert not (taught.root / "learning").exists()


def test_what_cannot_be_learned_is_refused_and_nothing_happens(
    taught: Taught, rooms: Rooms, options: LearnOptions, tmp_path: Path, tree: Tree
) -> None:
    before = tree(taught.root)
    with pytest.raises(InputError, match=r"'alpha'.*--name"):
        learn_scene(taught.root, replace(rooms[2], name="alpha"), options)
    with pytest.raises(InputError, match=r"'finetune'.*'evercal_network'"):
        learn_scene(taught.root, rooms[2], replace(options, strategy=STRATEGIES["finetune"]))
    with pytest.raises(InputError, match="'gamma': 15 training frames"):
        learn_scene(taught.root, replace(rooms[2], train=rooms[2].train[:15]), options)
    assert tree(taught.root) == before
    with pytest.raises(InputError, match="15 training frames"):
        learn_scene(tmp_path / "new", replace(rooms[2], train=rooms[2].train[:15]), options)
    assert not (tmp_path / "new").exists()
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="not an evercal store"):
        learn_scene(tmp_path, rooms[2], options)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_nothing_is_learned_into_a_store_of_an_unknown_strategy(
    taught: Taught, rooms: Rooms, options: LearnOptions, tmp_path: Path, tree: Tree
) -> None:
    root = tmp_path / "store"
    shutil.copytree(taught.root, root)
    manifest = json.loads((root / MANIFEST).read_text())
    payload = manifest["payload"] | {"strategy": "of the future"}
    write_manifest(root, payload, list(manifest["files"]))
    before = tree(root)
    with pytest.raises(InputError, match=r"'evercal_network'.*made with 'of the future'"):
        learn_scene(root, rooms[2], options)
    assert tree(root) == before


def test_what_learns_all_scenes_at_once_makes_no_store(
    rooms: Rooms, options: LearnOptions, tmp_path: Path
) -> None:
    joint = replace(options, strategy=STRATEGIES["joint"])
    with pytest.raises(InputError, match=r"'joint'.*evercal bench"):
        learn_scene(tmp_path / "store", rooms[0], joint)
    assert list(tmp_path.iterdir()) == []


class Stop(Exception):
    """Thrown into a run to end it."""


def stop_at(kind: str, number: int) -> Callable[[object], None]:
    """Ends the run at the n-th checkpoint of rows or of the training."""
    count = [0]

    def watch(event: object) -> None:
        if isinstance(event, Checkpoint) and getattr(event, kind):
            count[0] += 1
            if count[0] == number:
                raise Stop

    return watch


@pytest.mark.parametrize(("kind", "number"), [("rows", 1), ("rows", 3), ("trainer", 5)])
def test_an_interrupted_scene_goes_on_where_it_stopped(
    kind: str,
    number: int,
    taught: Taught,
    rooms: Rooms,
    options: LearnOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    learned: Tree,
) -> None:
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
    store = tmp_path / "store"
    for room in rooms[:2]:  # the first scene of a store and a later one
        with pytest.raises(Stop):
            learn_scene(store, room, options, stop_at(kind, number))
        events: list[object] = []
        assert learn_scene(store, room, options, events.append).resumed
        steps = [event.step for event in events if isinstance(event, Progress)]
        assert steps[0] == (number + 1 if kind == "trainer" else 1)
    assert learned(store) == learned(taught.root)


def test_aligning_an_earlier_scene_does_not_begin_the_newest_anew(
    taught: Taught,
    rooms: Rooms,
    options: LearnOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
    store = tmp_path / "store"
    learn_scene(store, rooms[0], options)
    with pytest.raises(Stop):
        learn_scene(store, rooms[1], options, stop_at("rows", 1))
    opened = Store.open(store)
    aligned = replace(opened.maps.scenes[0], alignment=Alignment(SE3.exp([1.0, 2, 3, 0, 0, 0])))
    opened.replace_record("alpha", aligned)
    assert learn_scene(store, rooms[1], options).resumed


def test_a_second_learner_is_kept_out(
    taught: Taught, rooms: Rooms, options: LearnOptions, tmp_path: Path, learned: Tree
) -> None:
    store, meanwhile = tmp_path / "store", []

    def intrude(event: object) -> None:
        if not meanwhile:
            with pytest.raises(InputError, match="another process is learning into it") as refusal:
                learn_scene(store, rooms[1], options)
            meanwhile.append(str(refusal.value))

    learn_scene(store, rooms[0], options, intrude)
    assert len(meanwhile) == 1
    learn_scene(store, rooms[1], options)  # later it may
    assert learned(store) == learned(taught.root)
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


def test_another_stage_does_not_resume(
    taught: Taught,
    rooms: Rooms,
    options: LearnOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    learned: Tree,
) -> None:
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
    store = tmp_path / "store"
    alpha = rooms[0]
    moved = SE3.exp(np.array([0.01, 0, 0, 0, 0, 0]))
    first = alpha.train[0]
    assert first.base_from_camera is not None
    shaken = replace(first, base_from_camera=moved @ first.base_from_camera)
    others = {
        "name": (replace(alpha, name="other"), options),
        "pose": (replace(alpha, train=(shaken, *alpha.train[1:])), options),
        "seed": (alpha, replace(options, stage=replace(options.stage, seed=3))),
    }
    for train_split, asked in others.values():
        with pytest.raises(Stop):
            learn_scene(store, train_split, asked, stop_at("trainer", 2))
        with pytest.raises(Stop):
            learn_scene(store, alpha, options, stop_at("rows", 1))
    assert learn_scene(store, alpha, options).resumed  # its own
    learn_scene(store, rooms[1], options)
    assert learned(store) == learned(taught.root)


CHILD = """
import json, sys, time
from pathlib import Path
from evercal.continual import stage_rows
from evercal.continual.stage import StageOptions
from evercal.continual.strategies import STRATEGIES
from evercal.recordings import generic
from evercal.continual.learn_scene import LearnOptions, learn_scene
from evercal.continual.networks.head import HeadOptions
from evercal.continual.networks.buffer import EncodePlan
from evercal.continual.networks.trainer import FitOptions, Progress
from evercal.features.views import ViewOptions
stage_rows.CHECKPOINT_SECONDS = 0.0
stage = StageOptions(
    head=HeadOptions(width=16, centres_per_scene=3),
    fit=FitOptions(iterations=8, batch=64, replay_batch=32),
    encode=EncodePlan(views_per_frame=2, cells=24, view=ViewOptions(short_side=48)),
    replay_views_per_frame=2,
)
def linger(event):
    if isinstance(event, Progress) and event.step == 6:
        print("now", flush=True)
        time.sleep(600)
scene = generic.load(Path(sys.argv[2]))
options = LearnOptions(stage, STRATEGIES["evercal_network"], short_side=48)
learn_scene(Path(sys.argv[1]), scene, options, linger)
"""


MAP_CHILD = """
import sys, time
from pathlib import Path
from evercal.continual.learn_scene import LearnOptions, learn_scene
from evercal.recordings import generic
from evercal.mapping.build import Mapping
def linger(event):
    if isinstance(event, Mapping) and event.what == sys.argv[3]:
        print("now", flush=True)
        time.sleep(600)
learn_scene(Path(sys.argv[1]), generic.load(Path(sys.argv[2])), LearnOptions(short_side=48), linger)
"""


@pytest.fixture(scope="module")
def mapped(
    rooms: Rooms, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[LearnReport], list[object]]:
    """A store of maps after two scenes, with the reports and the events."""
    root, events = tmp_path_factory.mktemp("mapped") / "store", []
    for room in rooms[:2]:
        generic.write(root.parent / room.name, room)
    scenes = [generic.load(root.parent / room.name) for room in rooms[:2]]
    options = LearnOptions(short_side=48)
    reports = []
    for scene in scenes:
        reports.append(learn_scene(root, scene, options, events.append))
        shutil.copytree(root, root.parent / f"after-{scene.name}")
    return root, reports, events


def test_a_map_is_learned_without_a_step(
    mapped: tuple[Path, list[LearnReport], list[object]],
) -> None:
    root, reports, events = mapped
    maps = Store.open(root).maps
    assert maps.strategy == "evercal"
    assert maps.heads == []
    for i, report in enumerate(reports):
        keyframes, record = maps.keyframes[i], maps.scenes[i]
        assert keyframes is not None
        assert (report.iterations, report.head_bytes, report.resumed) == (0, 0, False)
        assert report.landmarks == sum(map(len, keyframes.landmarks)) > 30
        assert report.frames_kept == len(keyframes) == 2
        assert report.adjusted is not None
        assert report.adjusted.residual_px < 0.5
        assert report.adjusted.wrong_poses == ()
        assert MIN_SUPPORT <= record.min_support <= MAX_SUPPORT
        assert record.refined_camera is not None
    whats = {event.what for event in events if isinstance(event, Mapping)}
    assert whats == {"encoding", "mapping", "adjusting"}
    assert {type(event) for event in events} == {Mapping}


@pytest.mark.parametrize("what", ["encoding", "mapping", "adjusting"])
def test_kill_nine_while_a_map_is_built(
    what: str,
    mapped: tuple[Path, list[LearnReport], list[object]],
    rooms: Rooms,
    tmp_path: Path,
    tree: Tree,
    learned: Tree,
) -> None:
    whole, store = mapped[0], tmp_path / "store"
    shutil.copytree(whole.parent / "after-alpha", store)
    image = rooms[0].train[0].read_image()
    before, expected = tree(store), Localizer.open(store).localize(image)
    command = [sys.executable, "-c", MAP_CHILD, str(store), str(whole.parent / "beta"), what]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "now\n"
        child.send_signal(signal.SIGKILL)
        assert child.wait(60) == -signal.SIGKILL
    # The store is at its last complete scene and says the same.
    now = tree(store)
    assert {name: now.get(name) for name in before} == before
    assert all(name.startswith("learning/") for name in now.keys() - before.keys())
    found = Localizer.open(store)
    assert found.scenes == ("alpha",)
    again = found.localize(image)
    assert (again.status, again.inliers) == (expected.status, expected.inliers)
    assert again.status == "ok"
    # And the same command succeeds, with the same outcome as without the kill.
    learn_scene(store, generic.load(whole.parent / "beta"), LearnOptions(short_side=48))
    assert learned(store).keys() == learned(whole).keys()
    one, two = (Store.open(root).maps.keyframes[1] for root in (store, whole))
    assert one is not None
    assert two is not None
    assert list(map(len, one.landmarks)) == list(map(len, two.landmarks))
    for a, b in zip(one.landmarks, two.landmarks, strict=True):
        np.testing.assert_allclose(a.inverse_depth, b.inverse_depth, rtol=1e-6)


def test_a_stop_while_a_map_is_built_leaves_nothing_that_counts(
    mapped: tuple[Path, list[LearnReport], list[object]], tmp_path: Path, learned: Tree
) -> None:
    whole, store = mapped[0], tmp_path / "store"
    alpha = generic.load(whole.parent / "alpha")

    def stop(event: object) -> None:
        if isinstance(event, Mapping) and event.what == "mapping":
            raise Stop

    with pytest.raises(Stop):
        learn_scene(store, alpha, LearnOptions(short_side=48), stop)
    with pytest.raises(InputError):
        Store.open(store)  # nothing was learned yet
    report = learn_scene(store, alpha, LearnOptions(short_side=48))
    assert learned(store) == learned(whole.parent / "after-alpha")
    assert not report.resumed


def test_frames_without_parallax_are_refused_and_leave_nothing(
    rooms: Rooms, tmp_path: Path
) -> None:
    spot = np.array([0.0, 0, 1.3])
    frames = tuple(
        replace(f, base_from_camera=SE3(f.base_from_camera.rotation_wxyz, spot))
        for f in rooms[0].train
        if f.base_from_camera
    )
    with pytest.raises(InputError, match="under parallax"):
        learn_scene(tmp_path / "s", replace(rooms[0], train=frames), LearnOptions(short_side=48))
    assert not (tmp_path / "s").exists()


def test_kill_nine(
    taught: Taught, rooms: Rooms, options: LearnOptions, tmp_path: Path, tree: Tree
) -> None:
    generic.write(tmp_path / "beta", rooms[1])
    beta, store = generic.load(tmp_path / "beta"), tmp_path / "store"
    learn_scene(store, rooms[0], options)
    image = rooms[0].train[0].read_image()
    before, expected = tree(store), Localizer.open(store).localize(image)
    command = [sys.executable, "-c", CHILD, str(store), str(tmp_path / "beta")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "now\n"
        child.send_signal(signal.SIGKILL)
        assert child.wait(60) == -signal.SIGKILL
    # What was there is there, and says the same.
    now = tree(store)
    assert {name: now.get(name) for name in before} == before
    assert all(name.startswith("learning/") for name in now.keys() - before.keys())
    found = Localizer.open(store)
    assert found.scenes == ("alpha",)
    again = found.localize(image)
    assert (again.status, again.inliers) == (expected.status, expected.inliers)
    # And it goes on after the fifth step, to the same end.
    steps: list[int] = []
    report = learn_scene(
        store, beta, options, lambda e: steps.append(e.step) if isinstance(e, Progress) else None
    )
    assert report.resumed
    assert steps == [6, 7, 8]
    maps, whole = Store.open(store).maps, Store.open(taught.root).maps
    for name, value in maps.heads[0].state_dict().items():
        torch.testing.assert_close(value, whole.heads[0].state_dict()[name], rtol=0, atol=2e-3)
