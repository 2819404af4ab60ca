"""A store opens at its last complete scene after kill -9 at any step and after a full disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.mapping.store import MapStore
from evercal.storage.manifest import MANIFEST

Make = Callable[[Path, Sequence[SceneMap]], MapStore]
Tree = Callable[[Path], dict[str, str]]
Contents = Callable[[MapContents], list[object]]
Record = Callable[[Path, Callable[[], object]], list[Path]]


def test_store_survives_a_kill_while_a_scene_is_added(
    scenes: list[SceneMap],
    tmp_path: Path,
    every_step: Record,
    make: Make,
    tree: Tree,
    content: Contents,
) -> None:
    root = tmp_path / "store"
    make(root, scenes[:1])
    expected = [content(MapStore.open(root).contents)]
    snapshots = every_step(root, lambda: MapStore.open(root).commit(scenes[1], {}))
    expected.append(content(MapStore.open(root).contents))
    counts = []
    for snapshot in snapshots:
        store = MapStore.open(snapshot)
        counts.append(len(store.stages))
        assert content(store.contents) == expected[counts[-1] - 1]
    assert counts == sorted(counts)
    assert len(counts) > 15
    complete = counts.index(2)
    for i in {0, complete // 3, 2 * complete // 3, complete - 1}:
        again = tmp_path / f"again-{i}"
        shutil.copytree(snapshots[i], again)
        MapStore.open(again).commit(scenes[1], {})
        assert tree(again) == tree(root)


def test_store_survives_a_kill_while_the_first_scene_is_added(
    scenes: list[SceneMap],
    tmp_path: Path,
    every_step: Record,
    make: Make,
    tree: Tree,
    content: Contents,
) -> None:
    root = tmp_path / "store"
    snapshots = every_step(root, lambda: make(root, scenes[:1]))
    expected, opened = content(MapStore.open(root).contents), 0
    for i, snapshot in enumerate(snapshots):
        if (snapshot / MANIFEST).exists():
            assert content(MapStore.open(snapshot).contents) == expected
            opened += 1
            continue
        again = tmp_path / f"again-{i}"
        if snapshot.exists():
            shutil.copytree(snapshot, again)
        make(again, scenes[:1])
        assert tree(again) == tree(root)
    assert 0 < opened < len(snapshots) - 10


def test_full_disk_leaves_the_store_unchanged(
    scenes: list[SceneMap],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    make: Make,
    content: Contents,
) -> None:
    root = tmp_path / "store"
    make(root, scenes[:1])
    expected, sync, failures = content(MapStore.open(root).contents), os.fsync, 0
    for step in range(1, 100):
        steps = iter(range(1, 1000))

        def full(descriptor: int, steps: Iterator[int] = steps, last: int = step) -> None:
            if next(steps) >= last:
                raise OSError(28, "No space left on device")
            sync(descriptor)

        store = MapStore.open(root)
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            try:
                store.commit(scenes[1], {})
            except OSError:
                failures += 1
        opened = MapStore.open(root)
        if len(opened.stages) == 2:
            break
        assert content(opened.contents) == expected
        assert store.stages == opened.stages
    assert failures > 5
    assert len(MapStore.open(root).stages) == 2
