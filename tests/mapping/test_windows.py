"""Every change of a map works where nothing that is open can be renamed or removed."""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path

import pytest

from evercal.cli import main
from evercal.mapping.manage import (
    merge_maps,
    pack_map,
    remove_scenes,
    rename_scene,
    unpack_map,
)
from evercal.mapping.scene_map import SceneMap
from evercal.mapping.store import MapStore
from evercal.storage.manifest import verify

pytestmark = pytest.mark.usefixtures("windows")


def test_scenes_are_learned_refreshed_packed_unpacked_and_merged(
    tmp_path: Path, root: Path, scenes: list[SceneMap]
) -> None:
    store = MapStore.open(root)
    store.refresh(scenes[0], {"scene": "alpha"})
    store.undo("alpha")
    pack_map(root, tmp_path / "map.zip")
    pack_map(root, tmp_path / "map.zip")
    unpack_map(tmp_path / "map.zip", tmp_path / "unpacked")
    merged = MapStore.create(tmp_path / "merged", store.contents.encoder, 48)
    merge_maps(merged, [tmp_path / "unpacked"])
    assert MapStore.open(merged.root).contents.names == ["alpha", "beta", "gamma"]
    assert verify(root) == verify(merged.root) == []


def test_what_is_open_is_removed_by_a_later_change(root: Path) -> None:
    server = MapStore.open(root)
    store = MapStore.open(root)
    before = store.stages[0]
    rename_scene(store, "alpha", "hall.")
    remove_scenes(store, ["beta"])
    left = {*os.listdir(root / "stages")}.difference(store.stages)
    assert before in left
    assert len(left) >= 2
    assert server.contents.scenes[0].keyframes.images[0]  # it can still be read
    assert not store.stages[0].endswith(".")  # Windows would leave that away
    del server, store
    remove_scenes(MapStore.open(root), ["gamma"])
    opened = MapStore.open(root)
    rename_scene(opened, "hall.", "hall")
    assert len([*(root / "stages").iterdir()]) <= 2  # the last one is open here


@pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
def test_names_are_printed_whatever_letters_a_terminal_has(
    encoding: str, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename_scene(MapStore.open(root), "alpha", "厨房 ü")
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding))
    assert main(["map", "rename", str(root), "厨房 ü", "küche"]) == 0
    assert main(["map", "--help"]) == 0
    assert main(["map", "rename", str(root), "küche", "厨房"]) == 0
    assert r"\u53a8\u623f" in shown.getvalue().decode(encoding)
