"""Scenes are removed, renamed, merged, packed and unpacked: completely, or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.mapping import manage
from evercal.mapping.manage import (
    OnClash,
    merge_maps,
    pack_map,
    remove_scenes,
    rename_scene,
    unpack_map,
)
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.mapping.store import MapStore
from evercal.storage.manifest import MANIFEST, verify

Make = Callable[[Path, Sequence[SceneMap]], MapStore]
Tree = Callable[[Path], dict[str, str]]
Contents = Callable[[MapContents], list[object]]
Record = Callable[[Path, Callable[[], object]], list[Path]]


def names(root: Path) -> list[str]:
    return MapStore.open(root).contents.names


def frames_of(root: Path) -> dict[str, int]:
    return {
        scene.name: scene.train_frames for scene in MapStore.open(root).contents.scenes
    }


@pytest.mark.parametrize(
    "gone", [["alpha"], ["beta"], ["gamma", "alpha"], ["beta", "alpha"]]
)
def test_removed_scenes_are_gone_and_the_others_unchanged(
    gone: list[str], root: Path, scenes: list[SceneMap], content: Contents
) -> None:
    before = {scene.name: scene for scene in MapStore.open(root).contents.scenes}
    store = MapStore.open(root)
    remove_scenes(store, gone)
    left = [scene for name, scene in before.items() if name not in gone]
    opened = MapStore.open(root)
    for contents in (store.contents, opened.contents):
        assert content(contents) == content(replace(contents, scenes=left))
    assert verify(root) == []
    assert sorted(os.listdir(root / "stages")) == sorted(opened.stages)


def test_a_map_without_scenes_can_grow_again(
    root: Path, scenes: list[SceneMap]
) -> None:
    store = MapStore.open(root)
    remove_scenes(store, ["alpha", "beta", "gamma"])
    assert names(root) == []
    store.commit(scenes[1], {"scene": "beta"})
    assert names(root) == ["beta"]


def test_no_folder_name_is_used_again(root: Path, scenes: list[SceneMap]) -> None:
    """A process that opened the map before would take the new scene for the old one."""
    late = MapStore.open(root)
    store = MapStore.open(root)
    remove_scenes(store, ["gamma"])
    store.commit(replace(scenes[2], train_frames=9), {"scene": "gamma"})
    assert store.stages == ["0001-alpha", "0002-beta", "0004-gamma"]
    rename_scene(store, "gamma", "hall")
    with pytest.raises(InputError, match="another process has changed it"):
        late.commit(replace(scenes[2], name="delta"), {})
    MapStore.open(root).commit(replace(scenes[2], name="delta"), {})
    assert MapStore.open(root).stages[-1] == "0005-delta"


def test_a_renamed_scene_keeps_its_place_and_content(
    root: Path, scenes: list[SceneMap], content: Contents
) -> None:
    before = MapStore.open(root).contents
    store = MapStore.open(root)
    rename_scene(store, "alpha", "Küche 2")
    renamed = [replace(before.scenes[0], name="Küche 2"), *before.scenes[1:]]
    opened = MapStore.open(root)
    for contents in (store.contents, opened.contents):
        assert content(contents) == content(replace(before, scenes=renamed))
    assert opened.reports()[0] == {"scene": "Küche 2", "seconds": 1.5}
    rename_scene(opened, "Küche 2", "alpha")
    assert content(MapStore.open(root).contents) == content(before)


def test_undo_keeps_a_later_name(root: Path, scenes: list[SceneMap]) -> None:
    store = MapStore.open(root)
    store.refresh(scenes[0], {})
    rename_scene(store, "alpha", "lobby")
    store.undo("lobby")
    assert MapStore.open(root).contents.scenes[0].name == "lobby"


def test_misuse_is_refused_by_name_and_changes_nothing(root: Path, tree: Tree) -> None:
    before = tree(root)
    store = MapStore.open(root)
    attempts: list[tuple[Callable[[], object], str]] = [
        (
            lambda: remove_scenes(store, ["alpha", "attic"]),
            "'attic'.* it has alpha, beta, gamma",
        ),
        (lambda: rename_scene(store, "attic", "a"), "scene 'attic'"),
        (
            lambda: rename_scene(store, "alpha", "beta"),
            "scene 'beta': .* has a scene of this name",
        ),
        (lambda: rename_scene(store, "alpha", "a/b"), "scene name 'a/b'"),
        (lambda: merge_maps(store, [root]), "is the map that scenes are merged into"),
        (lambda: merge_maps(store, [root / "gone"]), "gone: no such folder"),
        (lambda: pack_map(root, root / "x.zip"), "lies inside the map"),
    ]
    for attempt, message in attempts:
        with pytest.raises(InputError, match=message):
            attempt()
    with MapStore.open(root).writing():
        for change in (
            lambda: remove_scenes(store, ["beta"]),
            lambda: rename_scene(store, "beta", "b"),
        ):
            with pytest.raises(InputError, match="another process is writing"):
                change()
    assert tree(root) == before
    assert [scene.name for scene in store.contents.scenes] == ["alpha", "beta", "gamma"]


@pytest.mark.parametrize(
    ("on_clash", "expected"),
    [
        ("rename", {"alpha": 30, "beta": 31, "gamma": 32, "beta-2": 7, "delta": 32}),
        ("skip", {"alpha": 30, "beta": 31, "gamma": 32, "delta": 32}),
        ("replace", {"alpha": 30, "gamma": 32, "beta": 7, "delta": 32}),
    ],
)
def test_names_that_are_taken(
    on_clash: OnClash, expected: dict[str, int], root: Path, other: Path, tree: Tree
) -> None:
    before = tree(root)
    source = tree(other)
    store = MapStore.open(root)
    with pytest.raises(
        InputError, match=r"scene 'beta' of map .*other: the name is taken"
    ):
        merge_maps(store, [other])
    assert tree(root) == before
    merged = merge_maps(store, [other], on_clash)
    assert frames_of(root) == expected
    assert list(frames_of(root)) == list(expected)
    assert [scene.name for scene in store.contents.scenes] == list(expected)
    assert merged.renamed == ((("beta", "beta-2"),) if on_clash == "rename" else ())
    assert (merged.skipped, merged.replaced) == (
        ("beta",) if on_clash == "skip" else (),
        ("beta",) if on_clash == "replace" else (),
    )
    reports = {report["scene"] for report in MapStore.open(root).reports()}
    assert reports == set(expected)
    assert verify(root) == []
    assert tree(other) == source


def test_two_maps_with_one_name_between_them(
    other: Path, scenes: list[SceneMap], tmp_path: Path, make: Make
) -> None:
    third = make(tmp_path / "third", [replace(scenes[0], name="delta")]).root
    for on_clash, expected in (
        ("rename", ["beta", "delta", "delta-2"]),
        ("skip", ["beta", "delta"]),
        ("replace", ["beta", "delta"]),
    ):
        store = MapStore.create(tmp_path / on_clash)
        merge_maps(store, [other, third], on_clash)  # type: ignore[arg-type]
        assert names(store.root) == expected


def test_a_new_map_has_the_encoder_of_the_first_one(
    other: Path, tmp_path: Path, content: Contents
) -> None:
    store = MapStore.create(tmp_path / "new")
    merge_maps(store, [other])
    opened = MapStore.open(tmp_path / "new")
    source = MapStore.open(other)
    assert opened.networks == source.networks
    assert (opened.contents.short_side, store.contents.short_side) == (48, 48)
    assert (
        content(opened.contents) == content(source.contents) == content(store.contents)
    )


@pytest.mark.parametrize("difference", ["encoder", "size"])
def test_maps_of_other_networks_are_refused(
    difference: str, root: Path, scenes: list[SceneMap], tmp_path: Path, tree: Tree
) -> None:
    foreign = MapStore.create(
        tmp_path / "foreign", short_side=48 if difference == "encoder" else 96
    )
    foreign.commit(replace(scenes[0], name="new"), {"scene": "new"})
    before = tree(root)
    message = (
        "another encoder" if difference == "encoder" else "image size 96, map .* has 48"
    )
    with pytest.raises(InputError, match=rf"map .*foreign: .*{message}"):
        merge_maps(MapStore.open(root), [foreign.root])
    assert tree(root) == before


def test_a_damaged_map_is_not_merged(root: Path, other: Path, tree: Tree) -> None:
    file = other / "stages" / "0002-delta" / "keyframes.safetensors"
    file.write_bytes(file.read_bytes()[:-1] + b"\0")
    before = tree(root)
    with pytest.raises(
        InputError, match=r"keyframes\.safetensors: checksum does not match"
    ):
        merge_maps(MapStore.open(root), [other], "skip")
    assert tree(root) == before


def test_a_map_that_changes_while_it_is_copied_is_refused(
    root: Path, other: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = manage.read_store

    def late(*args: object) -> object:
        result = read(*args)  # type: ignore[arg-type]
        remove_scenes(MapStore.open(other), ["delta"])
        return result

    monkeypatch.setattr(manage, "read_store", late)
    with pytest.raises(
        InputError, match=r"map .*other: another process has changed it"
    ):
        merge_maps(MapStore.open(root), [other], "skip")
    assert names(root) == ["alpha", "beta", "gamma"]


@pytest.mark.parametrize("action", ["remove", "rename", "merge", "merge into new"])
def test_a_kill_at_any_step_leaves_the_old_state_or_the_new_one(
    action: str,
    root: Path,
    other: Path,
    every_step: Record,
    tree: Tree,
    content: Contents,
) -> None:
    def change(where: Path) -> None:
        if action == "remove":
            remove_scenes(MapStore.open(where), ["beta", "alpha"])
        elif action == "rename":
            rename_scene(MapStore.open(where), "beta", "b")
        else:
            merge_maps(MapStore.open_or_create(where), [other], "rename")

    def state(where: Path) -> object:
        return (
            content(MapStore.open(where).contents)
            if (where / MANIFEST).exists()
            else None
        )

    folder = other.parent
    where = folder / "new" if action == "merge into new" else root
    before = state(where)
    snapshots = every_step(where, lambda: change(where))
    after = state(where)
    final = tree(where)
    outcomes = [state(snapshot) for snapshot in snapshots]
    assert all(outcome in (before, after) for outcome in outcomes)
    first = outcomes.index(after)
    assert all(outcome == after for outcome in outcomes[first:])
    assert first > 0
    for i in {0, first // 2, first - 1}:
        again = folder / "again" / str(i)
        if snapshots[i].exists():
            shutil.copytree(snapshots[i], again)
        change(again)
        assert tree(again) == final


CHANGES: dict[str, Callable[[Path, SceneMap], object]] = {
    "merge": lambda at, _: merge_maps(
        MapStore.open(at / "store"), [at / "other"], "replace"
    ),
    "merge into new": lambda at, _: merge_maps(
        MapStore.create(at / "new", short_side=48), [at / "other"]
    ),
    "first scene": lambda at, scene: MapStore.create(at / "new").commit(scene, {}),
    "commit": lambda at, scene: MapStore.open(at / "store").commit(
        replace(scene, name="more"), {}
    ),
    "rename": lambda at, _: rename_scene(MapStore.open(at / "store"), "gamma", "g"),
    "refresh": lambda at, scene: MapStore.open(at / "store").refresh(scene, {}),
    "unpack": lambda at, _: unpack_map(at / "packed.zip", at / "new"),
    "pack": lambda at, _: pack_map(at / "store", at / "again.zip"),
    "remove": lambda at, _: remove_scenes(MapStore.open(at / "store"), ["beta"]),
}


@pytest.mark.parametrize("name", CHANGES)
def test_changes_that_a_full_disk_refuses_leave_nothing(
    name: str,
    root: Path,
    other: Path,
    scenes: list[SceneMap],
    full_disk: Callable[..., AbstractContextManager[list[str]]],
    everything: Callable[[Path], dict[str, bytes | None]],
) -> None:
    """Each is refused at one call of every kind and at six others, then succeeds."""
    folder = other.parent
    pack_map(root, folder / "packed.zip")
    with tempfile.TemporaryDirectory() as trial, full_disk(10**6) as calls:
        shutil.copytree(folder, Path(trial) / "copy")
        before = len(calls)
        CHANGES[name](Path(trial) / "copy", scenes[0])
        kinds = np.array(calls[before:])
    rng = np.random.default_rng(len(name))
    one_of_each = [rng.choice(np.flatnonzero(kinds == kind)) for kind in set(kinds)]
    steps = sorted({*one_of_each, *rng.permutation(len(kinds))[:6]})
    state = everything(folder)
    refused = 0
    for step in [*steps, len(kinds)]:
        try:
            with full_disk(step + 1):
                CHANGES[name](folder, scenes[0])
            break
        except OSError as error:
            named = error.filename
            refused += 1
            assert named
            assert everything(folder) == state, (step, kinds[step])
    assert refused >= 3
    assert everything(folder) != state
    for place in (root, folder / "new"):
        assert not place.exists() or verify(place) == []


def test_a_map_that_lost_its_manifest_keeps_its_scenes(
    root: Path, other: Path, everything: Callable[[Path], dict[str, bytes | None]]
) -> None:
    pytest.importorskip("torch", reason="the extra 'networks' is not installed")
    from evercal.continual.store import NetworkStore

    packed = other.parent / "packed.zip"
    pack_map(other, packed)
    (root / MANIFEST).unlink()
    before = everything(root)
    for change in (
        lambda: MapStore.create(root),
        lambda: merge_maps(MapStore.open_or_create(root), [other]),
        lambda: NetworkStore.create(root, "finetune"),
        lambda: unpack_map(packed, root),
    ):
        with pytest.raises(
            InputError,
            match=r"store: (holds scenes but no manifest\.json; restore|exists)",
        ):
            change()
        assert everything(root) == before
