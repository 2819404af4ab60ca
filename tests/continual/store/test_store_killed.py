"""A store of networks opens at its last complete stage after kill -9 at any step."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import NetworkStore

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
    snapshots = every_step(root, lambda: NetworkStore.open(root).commit(stages[1], {}))
    expected.append(estimates(NetworkStore.open(root).contents))
    assert expected[0] != expected[1]
    counts = [len(NetworkStore.open(snapshot).stages) for snapshot in snapshots]
    assert counts == sorted(counts)
    assert len(counts) > 20
    # The rename of the manifest completes the stage; the old head is removed after it.
    complete = counts.index(2)
    assert complete < len(counts) - 1
    for i in (0, complete - 1, complete, len(counts) - 1):
        scenes = NetworkStore.open(snapshots[i]).contents
        assert estimates(scenes) == expected[counts[i] - 1]
    assert len(list(snapshots[complete].rglob("head.safetensors"))) == 2
    for i in {0, complete // 3, 2 * complete // 3, complete - 1}:
        store = NetworkStore.open(copied(snapshots[i], tmp_path / f"again-{i}"))
        store.commit(stages[1], {})
        assert tree(store.root) == tree(root)
    # The next stage also removes what an interrupted clean-up left.
    without_kill = tree(make_store(tmp_path / "without-kill", stages).root)
    for i in range(complete, len(counts)):
        store = NetworkStore.open(copied(snapshots[i], tmp_path / f"next-{i}"))
        store.commit(stages[2], {})
        assert tree(store.root).keys() == without_kill.keys()
