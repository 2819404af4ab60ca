"""A store of networks opens at its last complete stage after kill -9 at any step."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import torch

from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import Checkpoint, NetworkStore

from ..stages import Estimates, MakeStore, Tree

Stages = dict[str, list[LearnedScenes]]
Record = Callable[[Path, Callable[[], object]], list[Path]]


def copied(snapshot: Path, to: Path) -> Path:
    """A copy that can be changed."""
    shutil.copytree(snapshot, to)
    return to


def test_second_stage(
    three_stages: Stages,
    tmp_path: Path,
    every_step: Record,
    make_store: MakeStore,
    tree: Tree,
    estimates: Estimates,
) -> None:
    stages, root = three_stages["evercal_network"], tmp_path / "store"
    make_store(root, stages[:1])
    expected = [estimates(NetworkStore.open(root).contents)]
    identity = {"scene": "beta"}

    def second() -> None:
        store = NetworkStore.open(root)
        store.begin(identity)
        store.checkpoint(Checkpoint({"a": torch.zeros(3)}, {}))
        store.checkpoint(Checkpoint({}, {"b": torch.ones(3)}))
        store.commit(stages[1], {})

    snapshots = every_step(root, second)
    expected.append(estimates(NetworkStore.open(root).contents))
    assert expected[0] != expected[1]
    counts = []
    for snapshot in snapshots:
        store = NetworkStore.open(snapshot)
        counts.append(len(store.stages))
        assert estimates(store.contents) == expected[counts[-1] - 1]
    assert counts == sorted(counts)
    assert len(counts) > 20
    # The rename of the manifest completes the stage; the old head is removed after it.
    complete = counts.index(2)
    assert complete < len(counts) - 1
    assert (snapshots[complete] / "learning").is_dir()
    assert len(list(snapshots[complete].rglob("head.safetensors"))) == 2
    for i in {0, complete // 3, 2 * complete // 3, complete - 1}:
        store = NetworkStore.open(copied(snapshots[i], tmp_path / f"again-{i}"))
        resume = store.begin(identity)
        assert (resume is not None) == bool(list(snapshots[i].glob("learning/rows-*.safetensors")))
        store.commit(stages[1], {})
        assert tree(store.root) == tree(root)
    # The next stage also removes what an interrupted clean-up left.
    without_kill = tree(make_store(tmp_path / "without-kill", stages).root)
    for i in range(complete, len(counts)):
        store = NetworkStore.open(copied(snapshots[i], tmp_path / f"next-{i}"))
        store.begin({"scene": "gamma"})
        store.commit(stages[2], {})
        assert tree(store.root).keys() == without_kill.keys()


def test_checkpoints_of_an_abandoned_stage_are_never_resumed_in_part(
    three_stages: Stages, tmp_path: Path, every_step: Record, make_store: MakeStore
) -> None:
    root = tmp_path / "store"
    store = make_store(root, three_stages["evercal_network"][:1])
    store.begin({"scene": "beta"})
    for i in range(4):
        store.checkpoint(Checkpoint({"x": torch.tensor([i])}, {}))
    store.checkpoint(Checkpoint({}, {"y": torch.ones(1)}))
    for i, snapshot in enumerate(every_step(root, lambda: store.begin({"scene": "gamma"}))):
        copy = NetworkStore.open(copied(snapshot, tmp_path / str(i)))
        resume = copy.begin({"scene": "beta"})
        if resume is not None:
            assert [int(rows["x"]) for rows in resume.rows] == [0, 1, 2, 3]
            assert resume.trainer.keys() == {"y"}
