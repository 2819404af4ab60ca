"""A folder of stages: whole or not at all, one writer at a time, damage is reported."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from evercal.errors import InputError
from evercal.storage import MANIFEST, verify
from evercal.storage.stages import require_free

from .stores import FILES, NETWORK, PAYLOAD, Tree, add, change_by, opened, texts

Everything = Callable[[Path], dict[str, "bytes | None"]]
EveryStep = Callable[[Path, Callable[[], object]], list[Path]]
pytestmark = pytest.mark.usefixtures("quick_disk")


def test_stages_are_read_back_in_order(root: Path) -> None:
    assert texts(root) == ["kitchen", "hall"]
    store = opened(root)
    assert store.stages == ["0001-kitchen", "0002-hall"]
    files = [f"{stage}/{name}" for stage in store.stages for name in FILES]
    assert [*store.size_bytes()] == [NETWORK, *(f"stages/{file}" for file in files)]
    assert verify(root) == []
    add(store, "a b/c:d")
    assert store.stages[-1] == "0003-a_b_c_d"


def test_a_stage_is_replaced_and_its_other_files_stay(root: Path) -> None:
    store = opened(root)
    for _ in range(2):
        change_by("replace", store)
    assert texts(root) == ["new", "hall"]
    assert store.stages == ["0001-kitchen~3", "0002-hall"]
    assert sorted(os.listdir(root / "stages")) == sorted(store.stages)
    assert (root / "stages" / store.stages[0] / "head.bin").read_bytes() == bytes(100)


def test_superseded_files_of_earlier_stages_are_dropped(root: Path) -> None:
    store = opened(root)
    store.add("attic", lambda folder: None, PAYLOAD, lambda name: name == "head.bin")
    assert not list(root.rglob("head.bin"))
    assert verify(root) == []


@pytest.mark.parametrize("action", ["first", "add", "replace"])
def test_writer_killed_at_any_step(
    action: str, root: Path, every_step: EveryStep, tree: Tree
) -> None:
    if action == "first":
        shutil.rmtree(root)
    before = texts(root)
    snapshots = every_step(root, lambda: change_by(action, opened(root)))
    after = texts(root)
    outcomes = []
    for snapshot in snapshots:
        outcomes.append(texts(snapshot))
        assert outcomes[-1] in (before, after)
        if outcomes[-1] == before:
            change_by(action, opened(snapshot))
            assert tree(snapshot) == tree(root)
    # The change is complete at one step, and something remains to be tidied or synced after it.
    assert outcomes == sorted(outcomes, key=lambda outcome: outcome == after)
    assert len(snapshots) > 6
    assert outcomes[0] == before
    assert outcomes[-2] == after


@pytest.mark.parametrize("once", [False, True])
@pytest.mark.parametrize("action", ["first", "add", "replace", "remove"])
def test_a_change_that_is_refused_at_any_step_leaves_nothing(
    action: str,
    once: bool,
    root: Path,
    tmp_path: Path,
    full_disk: Any,
    everything: Everything,
) -> None:
    def copied(name: str) -> Path:
        copy = tmp_path / name / "store"
        copy.parent.mkdir()
        if action != "first":
            shutil.copytree(root, copy)
        return copy

    expected = copied("expected")
    change_by(action, opened(expected))
    refused = 0
    calls: list[str] = []
    for last in range(1, 200):
        where = copied(str(last))
        store = opened(where)
        before = everything(where.parent)
        memory = list(store.stages), store.networks
        try:
            with full_disk(last, once) as calls:
                change_by(action, store)
        except OSError:
            refused += 1
            assert everything(where.parent) == before
            assert (store.stages, store.networks) == memory
            change_by(action, store)  # the same object, once there is space
        assert everything(where) == everything(expected)
        if len(calls) < last:
            break
    else:
        pytest.fail("it was refused at every step")
    assert refused >= 6


def test_what_a_killed_change_dropped_is_removed_by_the_next(
    root: Path, every_step: EveryStep
) -> None:
    for snapshot in every_step(root, lambda: change_by("remove", opened(root))):
        store = opened(snapshot)
        add(store, "attic")
        assert {*os.listdir(snapshot / "stages")} == {*store.stages}
        assert {*os.listdir(snapshot)} == {NETWORK, MANIFEST, "stages"}


@pytest.mark.parametrize(
    "journal", [None, "", "[]", '{"new": [7]}', '{"dropped": ["0001-kitchen"]}']
)
def test_scenes_without_a_manifest_are_refused_and_never_removed(
    journal: str | None, root: Path, everything: Everything
) -> None:
    (root / MANIFEST).unlink()
    if journal is not None:
        (root / ".writing").write_text(journal)
    before = everything(root)
    for action in (partial(add, opened(root), "attic"), partial(require_free, root)):
        with pytest.raises(InputError, match=r"but no manifest\.json; restore it"):
            action()
        assert everything(root) == before


def test_a_stage_that_no_change_has_made_is_neither_removed_nor_replaced(
    root: Path,
) -> None:
    for name in ("0003-attic", "0001-kitchen~2"):
        shutil.copytree(root / "stages" / "0001-kitchen", root / "stages" / name)
    store = opened(root)
    add(store, "attic")
    change_by("replace", store)
    assert store.stages == ["0001-kitchen~3", "0002-hall", "0004-attic"]
    for name in ("0003-attic", "0001-kitchen~2"):
        assert (root / "stages" / name / "scene.json").read_text() == '"kitchen"'


BUSY = "another process is writing into it; wait"
LATE = "another process has changed it; run it again"


def test_one_process_writes_at_a_time(root: Path, tree: Tree) -> None:
    first = opened(root)
    second = opened(root)
    with first.writing():
        before = tree(root)
        for action in ("add", "replace"):
            with pytest.raises(InputError, match=BUSY):
                change_by(action, second)
        assert tree(root) == before
        add(first, "cellar")
    # The second one was opened before the cellar was added.
    with pytest.raises(InputError, match=LATE):
        add(second, "attic")
    assert texts(root) == ["kitchen", "hall", "cellar"]


def test_two_processes_that_create_a_store(tmp_path: Path) -> None:
    first, second = (opened(tmp_path / "store") for _ in range(2))
    add(first, "kitchen")
    with pytest.raises(InputError, match=LATE):
        add(second, "hall")
    assert texts(tmp_path / "store") == ["kitchen"]


def test_one_lock_under_every_name(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = root.with_name("link")
    link.symlink_to(root)
    monkeypatch.chdir(root)
    for one, other in itertools.permutations((root, link, Path()), 2):
        with opened(one).writing(), pytest.raises(InputError, match=BUSY):
            add(opened(other), "attic")


LOCKED = """
import sys, time
from pathlib import Path
from evercal.storage.stages import StageStore
store = StageStore(Path(sys.argv[1]), None, ["0001-kitchen", "0002-hall"])
with store.writing():
    print("locked", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def other_writer(root: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that is writing into the store."""
    command = [sys.executable, "-c", LOCKED, str(root)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "locked\n"
        yield process
        process.kill()


def test_a_killed_process_leaves_no_lock(
    root: Path, other_writer: subprocess.Popen[str]
) -> None:
    with pytest.raises(InputError, match=BUSY):
        add(opened(root), "attic")
    other_writer.kill()
    other_writer.wait()
    add(opened(root), "attic")
    assert texts(root) == ["kitchen", "hall", "attic"]


@pytest.mark.skipif(os.name != "posix", reason="Windows cannot remove an open file")
def test_no_lock_file_is_left_and_inner_locks_keep_it(root: Path) -> None:
    lock = root.parent / f".{root.name}.lock"
    store = opened(root)
    with store.writing():
        with store.writing():
            pass
        assert lock.exists()
        with pytest.raises(InputError, match=BUSY):
            add(opened(root), "attic")
    assert not lock.exists()


def race(root: str, name: str) -> None:
    for i in range(5):
        while True:
            try:
                add(opened(Path(root)), f"{name}-{i}")
                break
            except InputError as error:
                assert "another process" in str(error)  # noqa: PT017 - it tries again
                time.sleep(0.01)


def test_racing_processes_lose_no_stage(tmp_path: Path) -> None:
    # Locks and threads of this process do not survive a fork.
    context = multiprocessing.get_context("spawn")
    store = tmp_path / "s"
    arguments = [(str(store), name) for name in "abc"]
    processes = [context.Process(target=race, args=a, daemon=True) for a in arguments]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
        assert process.exitcode == 0
    assert sorted(texts(store)) == [f"{name}-{i}" for name in "abc" for i in range(5)]
