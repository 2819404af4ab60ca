"""A store comes back as it was written, and opens whatever the moment it was killed at."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual.knowledge import Knowledge
from evercal.continual.learn import Checkpoint, Stage, StageOptions, learn
from evercal.continual.robot import Robot, head_bytes, with_fit
from evercal.datasets.frame import Scene
from evercal.errors import InputError
from evercal.geometry.se3 import pose_distance
from evercal.localization.localizer import Localizer
from evercal.models.head import Head
from evercal.storage.manifest import MANIFEST, verify, write_manifest

Blank = Callable[[str], Knowledge]
Rooms = tuple[Scene, Scene, Scene]


@pytest.fixture(scope="module")
def taught(blank: Blank, rooms: Rooms, quick: StageOptions) -> dict[str, list[Knowledge]]:
    """By strategy: what is known after one, two and three rooms."""
    found: dict[str, list[Knowledge]] = {}
    for strategy in ("evercal", "isolation"):
        known, after = blank(strategy), []
        for scene in rooms:
            *_, stage = learn(known, scene, quick)
            assert isinstance(stage, Stage)
            known = stage.knowledge
            known.scenes[-1] = with_fit(known.scenes[-1], 0.01 * len(known.scenes), 1.5)
            after.append(known)
        found[strategy] = after
    return found


def make(root: Path, stages: list[Knowledge]) -> Robot:
    """A store with these stages, the way `teach` makes one."""
    first = stages[0]
    robot = Robot(root, replace(first, heads=[], scenes=[], memories=[]), [], None)
    for known in stages:
        robot.begin({"scene": known.scenes[-1].name})
        robot.checkpoint(Checkpoint({"a": torch.zeros(3)}, {"b": torch.ones(2)}))
        robot.commit(known, {"scene": known.scenes[-1].name, "seconds": 1.5})
    return robot


def tree(root: Path) -> dict[str, str]:
    """Checksums of all files under a folder."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def stored(head: Head) -> dict[str, Tensor]:
    """What a head is after half precision, but for its centres."""
    return {
        name: value if name == "centres" or not value.is_floating_point() else value.half().float()
        for name, value in head.state_dict().items()
    }


def answers(known: Knowledge, rooms: Rooms) -> list[bytes]:
    """What a robot says to some images, to the last bit."""
    localizer, said = Localizer(known), []
    for scene in rooms:
        for frame in scene.train[:1]:
            found = localizer.localize(frame.read_image(), frame.camera)
            pose = found.base_from_camera
            numbers = b"" if pose is None else pose.matrix().tobytes()
            said.append(repr((found.status, found.scene, found.inliers)).encode() + numbers)
    return said


@pytest.mark.parametrize("strategy", ["evercal", "isolation"])
def test_what_is_committed_is_what_opens(
    strategy: str, taught: dict[str, list[Knowledge]], tmp_path: Path
) -> None:
    stages = taught[strategy]
    robot, known = make(tmp_path / "store", stages), stages[-1]
    opened = Robot.open(tmp_path / "store")
    assert opened.stages == robot.stages
    again = opened.known
    assert (again.strategy, again.short_side) == (known.strategy, known.short_side)
    assert len(again.heads) == len(known.heads)
    for a, b in zip(again.heads, known.heads, strict=True):
        assert a.options == b.options
        assert not a.training
        state = stored(b)
        assert a.state_dict().keys() == state.keys()
        assert all(torch.equal(value, state[name]) for name, value in a.state_dict().items())
    for a, b in zip(again.scenes, known.scenes, strict=True):
        assert torch.equal(a.prototypes, b.prototypes)
        others = [field.name for field in fields(a) if field.name != "prototypes"]
        assert [getattr(a, name) for name in others] == [getattr(b, name) for name in others]
    for a, b in zip(again.memories, known.memories, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert (a.images, a.cameras) == (b.images, b.cameras)
            poses = a.base_from_camera, b.base_from_camera
            np.testing.assert_allclose(poses[0].matrix(), poses[1].matrix(), atol=1e-15)
    grey = torch.rand(1, 1, 48, 64, generator=torch.Generator().manual_seed(0))
    for name in ("encoder", "descriptor"):
        a, b = getattr(again, name), getattr(known, name)
        x = grey if name == "encoder" else known.encoder(grey)
        torch.testing.assert_close(a(x), b(x), rtol=0, atol=1e-6)


def test_everything_can_be_opened_and_written_again_without_a_change(
    taught: dict[str, list[Knowledge]], tmp_path: Path
) -> None:
    make(tmp_path / "a", taught["evercal"][:1])
    make(tmp_path / "b", [Robot.open(tmp_path / "a").known])
    a, b = tree(tmp_path / "a"), tree(tmp_path / "b")
    assert a.keys() == b.keys()
    # Quaternions are normalised on entry, which may change their last bit.
    changed = {Path(name).name for name in a if a[name] != b[name]}
    assert changed <= {"memory.safetensors", MANIFEST}


def test_poses_survive_the_disk(
    arc_known: tuple[Knowledge, Knowledge], arcs: tuple[Scene, Scene], tmp_path: Path
) -> None:
    make(tmp_path / "store", list(arc_known))
    before, after = Localizer(arc_known[1]), Localizer.open(tmp_path / "store")
    assert after.scenes == ("one", "two")
    sure = 0
    for frame in (*arcs[0].test[::4], *arcs[1].test[::4]):
        a, b = (one.localize(frame.read_image(), frame.camera) for one in (before, after))
        if a.inlier_ratio < 0.3 or a.base_from_camera is None:
            continue  # a pose that hangs by a thread may fall either way
        sure += 1
        assert (a.status, a.scene) == (b.status, b.scene)
        assert b.base_from_camera is not None
        metres, radians = pose_distance(a.base_from_camera, b.base_from_camera)
        assert metres < 0.05  # the head's weights were rounded to half precision
        assert radians < np.deg2rad(1)
    assert sure >= 6


@pytest.mark.parametrize(("strategy", "heads"), [("evercal", [3]), ("isolation", [1, 2, 3])])
def test_only_heads_that_count_are_kept(
    strategy: str, heads: list[int], taught: dict[str, list[Knowledge]], tmp_path: Path
) -> None:
    make(tmp_path, taught[strategy])
    found = sorted(path.parent.name[:4] for path in tmp_path.rglob("head.safetensors"))
    assert found == [f"{number:04d}" for number in heads]
    assert not (tmp_path / "learning").exists()
    assert verify(tmp_path) == []


def test_sizes_are_those_on_disk(taught: dict[str, list[Knowledge]], tmp_path: Path) -> None:
    robot = make(tmp_path, taught["evercal"])
    listed = [tmp_path / name for name in tree(tmp_path)]
    memory = [path.stat().st_size for path in listed if path.name == "memory.safetensors"]
    assert robot.bytes() == {
        "memory": sum(memory),
        "rest": sum(path.stat().st_size for path in listed) - sum(memory),
    }
    head = next(tmp_path.rglob("head.safetensors")).stat().st_size
    counted = head_bytes(robot.known.heads[0])
    assert counted < head < counted + 3000  # the file adds only its header
    shutil.copytree(tmp_path / "stages" / robot.stages[0], tmp_path / "stages" / "0009-stray")
    before = robot.bytes()
    (tmp_path / "stages" / "0009-stray" / "memory.safetensors").write_bytes(bytes(10_000))
    assert robot.bytes() == before


def test_any_name_of_a_scene_will_do(taught: dict[str, list[Knowledge]], tmp_path: Path) -> None:
    for name in ("../../etc", "a/b", "..", ".", "Küche 2", "x" * 300, 'a"b\nc', ""):
        first = taught["evercal"][0]
        known = replace(first, scenes=[replace(first.scenes[0], name=name)])
        root = tmp_path / "deep" / "store"
        make(root, [known])
        assert Robot.open(root).known.scenes[0].name == name
        assert list(tmp_path.iterdir()) == [tmp_path / "deep"]
        assert list((tmp_path / "deep").iterdir()) == [root]
        shutil.rmtree(root)


def test_every_flipped_byte_is_refused_by_name(
    taught: dict[str, list[Knowledge]], tmp_path: Path
) -> None:
    root = tmp_path / "store"
    make(root, taught["evercal"][:2])
    names = list(tree(root))
    # Two networks; camera, prototypes and report twice, memory twice, one head, the manifest.
    assert len(names) == 2 + 2 * 4 + 1 + 1
    rng = np.random.default_rng(0)
    for name in names:
        file = root / name
        whole = file.read_bytes()
        flipped = bytearray(whole)
        flipped[int(rng.integers(len(whole)))] ^= 1 << int(rng.integers(8))
        for broken in (bytes(flipped), whole[:-2], whole + b"\0", b""):
            file.write_bytes(broken)
            with pytest.raises(InputError, match=Path(name).name):
                Robot.open(root)
        file.unlink()
        with pytest.raises(InputError, match=Path(name).name):
            Robot.open(root)
        file.write_bytes(whole)
    Robot.open(root)


def test_what_is_not_a_store_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("x")
    (tmp_path / "stages").mkdir()  # has the right name, but no learning was going on beside it
    (tmp_path / "mixed" / "learning").mkdir(parents=True)
    (tmp_path / "mixed" / "thesis.tex").write_text("x")
    before = tree(tmp_path)
    for name in ("file", "photos", "missing", "stages", "mixed", ""):
        with pytest.raises(InputError, match=str(tmp_path / name)):
            Robot.open(tmp_path / name)
    for name in ("file", "photos", "mixed", ""):
        with pytest.raises(InputError, match="not an evercal store"):
            Robot.create(tmp_path / name, "evercal")
    with pytest.raises(InputError, match=r"'magic'.*finetune"):
        Robot.create(tmp_path / "new", "magic")
    Robot.create(tmp_path / "new", "evercal")
    assert tree(tmp_path) == before
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("change", [{"schema": 2}, {"strategy": "of the future"}])
def test_a_store_of_another_version_is_refused(
    change: dict[str, object], taught: dict[str, list[Knowledge]], tmp_path: Path
) -> None:
    make(tmp_path, taught["evercal"][:1])
    manifest = json.loads((tmp_path / MANIFEST).read_text())
    write_manifest(tmp_path, manifest["payload"] | change, list(manifest["files"]))
    with pytest.raises(InputError, match=str(next(iter(change.values())))):
        Robot.open(tmp_path)


def test_two_stores_share_nothing(
    taught: dict[str, list[Knowledge]], rooms: Rooms, tmp_path: Path
) -> None:
    stages = taught["evercal"]
    a, b = make(tmp_path / "a", stages[:1]), make(tmp_path / "b", stages[:1])
    before = tree(tmp_path / "b")
    a.begin({"scene": "beta"})
    a.commit(stages[1], {})
    shutil.rmtree(tmp_path / "a")
    assert tree(tmp_path / "b") == before
    assert b.stages == ["0001-alpha"]
    one, two = (Robot.open(tmp_path / "b").known for _ in range(2))
    expected = answers(two, rooms)
    with torch.no_grad():
        for parameter in (*one.heads[0].parameters(), one.scenes[0].prototypes):
            parameter.zero_()
    assert answers(two, rooms) == expected
    assert answers(one, rooms) != expected


def test_what_the_manifest_does_not_list_does_not_count(
    taught: dict[str, list[Knowledge]], rooms: Rooms, tmp_path: Path
) -> None:
    make(tmp_path, taught["evercal"][:1])
    expected = answers(Robot.open(tmp_path).known, rooms)
    stage = tmp_path / "stages" / "0001-alpha"
    strays = [tmp_path / "notes.txt", stage / ".DS_Store", tmp_path / "stages" / "README"]
    for stray in strays:
        stray.write_text("x")
    shutil.copytree(stage, tmp_path / "stages" / "0002-ghost")
    robot = Robot.open(tmp_path)
    assert answers(robot.known, rooms) == expected
    robot.begin({"scene": "beta"})
    robot.commit(taught["evercal"][1], {})
    for stray in strays:  # still the user's, and still nothing to us
        assert stray.read_text() == "x"
        stray.write_text("changed")
    assert Robot.open(tmp_path).stages == ["0001-alpha", "0002-beta"]
    assert not (tmp_path / "stages" / "0002-ghost").exists()


def test_checkpoints_come_back_to_the_same_stage_only(
    taught: dict[str, list[Knowledge]], tmp_path: Path
) -> None:
    robot = make(tmp_path, taught["evercal"][:1])
    asked = {"scene": "beta", "options": {"seed": 0, "size": (1, 2)}}
    assert robot.begin(asked) is None
    assert Robot.open(tmp_path).begin(asked) is None  # begun, but nothing done yet
    rows = [{"x": torch.arange(i, i + 3)} for i in range(12)]
    for part in rows:
        robot.checkpoint(Checkpoint(part, {}))
    robot.checkpoint(Checkpoint({}, {"step": torch.tensor(4)}))
    robot.checkpoint(Checkpoint({}, {"step": torch.tensor(7)}))
    for _ in range(2):
        found = Robot.open(tmp_path).begin(asked)
        assert found is not None
        assert len(found.rows) == 12
        for a, b in zip(found.rows, rows, strict=True):
            assert torch.equal(a["x"], b["x"])
        assert int(found.fitter["step"]) == 7
    assert robot.begin({**asked, "scene": "gamma"}) is None
    assert robot.begin(asked) is None


Snapshots = list[Path]


@pytest.fixture
def every_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[Path, Callable[[], object]], Snapshots]:
    """Runs something on a folder and returns what kill -9 would have left at each of its steps.

    A step is a call that changes names on disk or syncs them. Files are linked, not copied: a
    store never writes into a file that is in place.
    """

    def record(root: Path, action: Callable[[], object]) -> Snapshots:
        taken: Snapshots = []
        busy = [False]

        def photograph() -> None:
            busy[0] = True
            taken.append(tmp_path / "steps" / f"{len(taken):04d}" / "store")
            if root.exists():
                shutil.copytree(root, taken[-1], copy_function=os.link)
            busy[0] = False

        def watched(function: Callable[..., object]) -> Callable[..., object]:
            def call(*args: object, **kwargs: object) -> object:
                if not busy[0]:
                    photograph()
                return function(*args, **kwargs)

            return call

        with monkeypatch.context() as patch:
            for name in ("replace", "fsync", "unlink", "rmdir", "mkdir"):
                patch.setattr(os, name, watched(getattr(os, name)))
            action()
        photograph()
        return taken

    return record


def unlinked(snapshot: Path, to: Path) -> Path:
    """A copy that may be changed."""
    shutil.copytree(snapshot, to)
    return to


def test_killed_anywhere_in_a_second_stage(
    taught: dict[str, list[Knowledge]],
    rooms: Rooms,
    tmp_path: Path,
    every_step: Callable[[Path, Callable[[], object]], Snapshots],
) -> None:
    stages, root = taught["evercal"], tmp_path / "store"
    make(root, stages[:1])
    expected = [answers(Robot.open(root).known, rooms)]
    identity = {"scene": "beta"}

    def second() -> None:
        robot = Robot.open(root)
        robot.begin(identity)
        robot.checkpoint(Checkpoint({"a": torch.zeros(3)}, {}))
        robot.checkpoint(Checkpoint({}, {"b": torch.ones(3)}))
        robot.commit(stages[1], {})

    snapshots = every_step(root, second)
    expected.append(answers(Robot.open(root).known, rooms))
    assert expected[0] != expected[1]
    seen = []
    for snapshot in snapshots:
        robot = Robot.open(snapshot)
        seen.append(len(robot.stages))
        assert answers(robot.known, rooms) == expected[seen[-1] - 1]
    assert seen == sorted(seen)
    assert len(seen) > 20
    # The last step before the new stage counts is the rename of the manifest ...
    turn = seen.index(2)
    assert turn < len(seen) - 1
    left = {path.name for path in snapshots[turn].rglob("*")}
    # ... after which the old head and the checkpoints still lie about.
    assert "learning" in left
    assert len(list(snapshots[turn].rglob("head.safetensors"))) == 2
    for i in {0, turn // 3, 2 * turn // 3, turn - 1}:
        robot = Robot.open(unlinked(snapshots[i], tmp_path / f"again-{i}"))
        resume = robot.begin(identity)
        assert (resume is not None) == bool(list(snapshots[i].glob("learning/rows-*.safetensors")))
        robot.commit(stages[1], {})
        assert tree(robot.root) == tree(root)
    # Going on from a crash during the clean-up leaves no more behind than going on without one.
    without_a_crash = tree(make(tmp_path / "without-a-crash", stages).root)
    for i in range(turn, len(seen)):
        robot = Robot.open(unlinked(snapshots[i], tmp_path / f"on-{i}"))
        robot.begin({"scene": "gamma"})
        robot.commit(stages[2], {})
        assert tree(robot.root).keys() == without_a_crash.keys()


def test_killed_anywhere_in_the_first_stage(
    taught: dict[str, list[Knowledge]],
    rooms: Rooms,
    tmp_path: Path,
    every_step: Callable[[Path, Callable[[], object]], Snapshots],
) -> None:
    stages, root = taught["evercal"], tmp_path / "store"
    snapshots = every_step(root, lambda: make(root, stages[:1]))
    expected = answers(Robot.open(root).known, rooms)
    opened = 0
    for i, snapshot in enumerate(snapshots):
        if (snapshot / MANIFEST).exists():
            assert answers(Robot.open(snapshot).known, rooms) == expected
            opened += 1
            continue
        # No stage yet, so no store yet: learning begins anew or resumes, and is not refused.
        where = tmp_path / f"again-{i}"
        if snapshot.exists():
            unlinked(snapshot, where)
        robot = Robot.create(where, "evercal")
        resume = robot.begin({"scene": "alpha"})
        assert (resume is not None) == any(where.glob("learning/rows-*.safetensors"))
        robot.commit(stages[0], {"scene": "alpha", "seconds": 1.5})
        assert tree(where) == tree(root)
    assert 0 < opened < len(snapshots) - 10


def test_killed_while_giving_up_an_older_stage(
    taught: dict[str, list[Knowledge]],
    tmp_path: Path,
    every_step: Callable[[Path, Callable[[], object]], Snapshots],
) -> None:
    # Half of the rows of a stage must never be taken for that stage again.
    root = tmp_path / "store"
    robot = make(root, taught["evercal"][:1])
    robot.begin({"scene": "beta"})
    for i in range(4):
        robot.checkpoint(Checkpoint({"x": torch.tensor([i])}, {}))
    robot.checkpoint(Checkpoint({}, {"y": torch.ones(1)}))
    for i, snapshot in enumerate(every_step(root, lambda: robot.begin({"scene": "gamma"}))):
        resume = Robot.open(unlinked(snapshot, tmp_path / str(i))).begin({"scene": "beta"})
        if resume is not None:
            assert [int(rows["x"]) for rows in resume.rows] == [0, 1, 2, 3]
            assert resume.fitter.keys() == {"y"}


def test_a_full_disk_leaves_the_store_as_it_was(
    taught: dict[str, list[Knowledge]],
    rooms: Rooms,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stages, root = taught["evercal"], tmp_path / "store"
    make(root, stages[:1])
    expected = answers(Robot.open(root).known, rooms)
    whole, failures = os.fsync, 0
    for step in range(1, 100):
        steps = iter(range(1, 1000))

        def full(descriptor: int, steps: Iterator[int] = steps, last: int = step) -> None:
            if next(steps) >= last:
                raise OSError(28, "No space left on device")
            whole(descriptor)

        robot = Robot.open(root)
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            try:
                robot.commit(stages[1], {})
            except OSError:
                failures += 1
        opened = Robot.open(root)
        if len(opened.stages) == 2:
            break
        assert answers(opened.known, rooms) == expected
        assert robot.stages == opened.stages  # the object in memory does not run ahead
    assert failures > 5
    assert len(Robot.open(root).stages) == 2
