"""A store opens at its last complete stage, whatever the moment its writer was killed at."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from evercal.mapping.scene_maps import SceneMaps
from evercal.mapping.store import Checkpoint, Store
from evercal.storage.manifest import MANIFEST

Stages = dict[str, list[SceneMaps]]
Make = Callable[[Path, list[SceneMaps]], Store]
Tree = Callable[[Path], dict[str, str]]
Answers = Callable[..., list[bytes]]
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


BOTH = pytest.mark.parametrize("strategy", ["evercal", "evercal_network"])
"""A map and a network."""


@BOTH
def test_killed_anywhere_in_a_second_stage(
    strategy: str,
    taught: Stages,
    tmp_path: Path,
    every_step: Callable[[Path, Callable[[], object]], Snapshots],
    make: Make,
    tree: Tree,
    answers: Answers,
) -> None:
    stages, root = taught[strategy], tmp_path / "store"
    make(root, stages[:1])
    expected = [answers(Store.open(root).maps)]
    identity = {"scene": "beta"}

    def second() -> None:
        store = Store.open(root)
        store.begin(identity)
        store.checkpoint(Checkpoint({"a": torch.zeros(3)}, {}))
        store.checkpoint(Checkpoint({}, {"b": torch.ones(3)}))
        store.commit(stages[1], {})

    snapshots = every_step(root, second)
    expected.append(answers(Store.open(root).maps))
    assert expected[0] != expected[1]
    seen = []
    for snapshot in snapshots:
        store = Store.open(snapshot)
        seen.append(len(store.stages))
        assert answers(store.maps) == expected[seen[-1] - 1]
    assert seen == sorted(seen)
    assert len(seen) > 20
    # The last step before the new stage counts is the rename of the manifest ...
    turn = seen.index(2)
    assert turn < len(seen) - 1
    left = {path.name for path in snapshots[turn].rglob("*")}
    # ... after which the checkpoints and the old head, where there is one, still lie about.
    assert "learning" in left
    heads = 2 if strategy == "evercal_network" else 0
    assert len(list(snapshots[turn].rglob("head.safetensors"))) == heads
    for i in {0, turn // 3, 2 * turn // 3, turn - 1}:
        store = Store.open(unlinked(snapshots[i], tmp_path / f"again-{i}"))
        resume = store.begin(identity)
        assert (resume is not None) == bool(list(snapshots[i].glob("learning/rows-*.safetensors")))
        store.commit(stages[1], {})
        assert tree(store.root) == tree(root)
    # Going on from a crash during the clean-up leaves no more behind than going on without one.
    without_a_crash = tree(make(tmp_path / "without-a-crash", stages).root)
    for i in range(turn, len(seen)):
        store = Store.open(unlinked(snapshots[i], tmp_path / f"on-{i}"))
        store.begin({"scene": "gamma"})
        store.commit(stages[2], {})
        assert tree(store.root).keys() == without_a_crash.keys()


@BOTH
def test_killed_anywhere_in_the_first_stage(
    strategy: str,
    taught: Stages,
    tmp_path: Path,
    every_step: Callable[[Path, Callable[[], object]], Snapshots],
    make: Make,
    tree: Tree,
    answers: Answers,
) -> None:
    stages, root = taught[strategy], tmp_path / "store"
    snapshots = every_step(root, lambda: make(root, stages[:1]))
    expected = answers(Store.open(root).maps)
    opened = 0
    for i, snapshot in enumerate(snapshots):
        if (snapshot / MANIFEST).exists():
            assert answers(Store.open(snapshot).maps) == expected
            opened += 1
            continue
        # No stage yet, so no store yet: learning begins anew or resumes, and is not refused.
        where = tmp_path / f"again-{i}"
        if snapshot.exists():
            unlinked(snapshot, where)
        store = Store.create(where, strategy)
        resume = store.begin({"scene": "alpha"})
        assert (resume is not None) == any(where.glob("learning/rows-*.safetensors"))
        store.commit(stages[0], {"scene": "alpha", "seconds": 1.5})
        assert tree(where) == tree(root)
    assert 0 < opened < len(snapshots) - 10


@BOTH
def test_killed_while_giving_up_an_older_stage(
    strategy: str,
    taught: Stages,
    tmp_path: Path,
    every_step: Callable[[Path, Callable[[], object]], Snapshots],
    make: Make,
) -> None:
    # Half of the rows of a stage must never be taken for that stage again.
    root = tmp_path / "store"
    store = make(root, taught[strategy][:1])
    store.begin({"scene": "beta"})
    for i in range(4):
        store.checkpoint(Checkpoint({"x": torch.tensor([i])}, {}))
    store.checkpoint(Checkpoint({}, {"y": torch.ones(1)}))
    for i, snapshot in enumerate(every_step(root, lambda: store.begin({"scene": "gamma"}))):
        resume = Store.open(unlinked(snapshot, tmp_path / str(i))).begin({"scene": "beta"})
        if resume is not None:
            assert [int(rows["x"]) for rows in resume.rows] == [0, 1, 2, 3]
            assert resume.trainer.keys() == {"y"}


@BOTH
def test_a_full_disk_leaves_the_store_as_it_was(
    strategy: str,
    taught: Stages,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    make: Make,
    answers: Answers,
) -> None:
    stages, root = taught[strategy], tmp_path / "store"
    make(root, stages[:1])
    expected = answers(Store.open(root).maps)
    whole, failures = os.fsync, 0
    for step in range(1, 100):
        steps = iter(range(1, 1000))

        def full(descriptor: int, steps: Iterator[int] = steps, last: int = step) -> None:
            if next(steps) >= last:
                raise OSError(28, "No space left on device")
            whole(descriptor)

        store = Store.open(root)
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            try:
                store.commit(stages[1], {})
            except OSError:
                failures += 1
        opened = Store.open(root)
        if len(opened.stages) == 2:
            break
        assert answers(opened.maps) == expected
        assert store.stages == opened.stages  # the object in memory does not run ahead
    assert failures > 5
    assert len(Store.open(root).stages) == 2
