"""Scenes are removed, renamed, merged, packed and unpacked: completely, or not at all."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import pytest

from evercal.continual.store import NetworkStore
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
from evercal.storage.archive import ArchiveLimits
from evercal.storage.manifest import MANIFEST, Manifest, verify, write_manifest

Make = Callable[[Path, Sequence[SceneMap]], MapStore]
Tree = Callable[[Path], dict[str, str]]
Contents = Callable[[MapContents], list[object]]
Record = Callable[[Path, Callable[[], object]], list[Path]]


@pytest.fixture
def root(scenes: list[SceneMap], tmp_path: Path, make: Make) -> Path:
    """A map of alpha, beta and gamma."""
    return make(tmp_path / "store", scenes).root


@pytest.fixture
def other(scenes: list[SceneMap], tmp_path: Path, make: Make) -> Path:
    """A map of beta, with a number of frames of its own, and delta."""
    beta = replace(scenes[1], train_frames=7)
    delta = replace(scenes[2], name="delta")
    return make(tmp_path / "other", [beta, delta]).root


def names(root: Path) -> list[str]:
    return [scene.name for scene in MapStore.open(root).contents.scenes]


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
    tmp_path: Path,
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

    where = tmp_path / "new" if action == "merge into new" else root
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
        again = tmp_path / "again" / str(i)
        if snapshots[i].exists():
            shutil.copytree(snapshots[i], again)
        change(again)
        assert tree(again) == final


def test_changes_that_a_full_disk_refuses_leave_nothing(
    root: Path,
    other: Path,
    scenes: list[SceneMap],
    tmp_path: Path,
    full_disk: Callable[..., AbstractContextManager[list[int]]],
    everything: Callable[[Path], dict[str, bytes | None]],
) -> None:
    """One after the other, each refused at each of its steps until it succeeds."""
    packed = tmp_path / "packed.zip"
    pack_map(root, packed)
    store = MapStore.open(root)
    new, merged = (
        MapStore.create(tmp_path / name, short_side=48) for name in ("new", "merged")
    )
    left: dict[str, Callable[[], object]] = {
        "merge": lambda: merge_maps(store, [other], "replace"),
        "merge into new": lambda: merge_maps(merged, [other]),
        "first scene": lambda: new.commit(scenes[0], {}),
        "commit": lambda: store.commit(replace(scenes[1], name="more"), {}),
        "rename": lambda: rename_scene(store, "gamma", "g"),
        "refresh": lambda: store.refresh(scenes[0], {}),
        "unpack": lambda: unpack_map(packed, tmp_path / "copy"),
        "pack": lambda: pack_map(root, tmp_path / "again.zip"),
        "remove": lambda: remove_scenes(store, ["beta"]),
    }
    refused: Counter[str] = Counter()
    for last in range(1, 200):
        for name, change in [*left.items()]:
            before = everything(tmp_path)
            try:
                with full_disk(last):
                    change()
                del left[name]
            except OSError:
                refused[name] += 1
                assert everything(tmp_path) == before, (name, last)
    assert not left
    assert len(refused) == 9
    assert min(refused.values()) >= 3
    assert sorted(names(root)) == ["alpha", "beta", "delta", "g", "more"]
    assert (names(new.root), names(merged.root)) == (["alpha"], ["beta", "delta"])
    for where in (root, new.root, merged.root, tmp_path / "copy"):
        assert verify(where) == []


def test_a_map_that_lost_its_manifest_keeps_its_scenes(
    root: Path, other: Path, everything: Callable[[Path], dict[str, bytes | None]]
) -> None:
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


def test_a_packed_map_is_unpacked_to_the_same_files(
    root: Path, tmp_path: Path, tree: Tree
) -> None:
    (root / "notes.txt").write_text("not of the map")
    pack_map(root, tmp_path / "map.zip")
    unpack_map(tmp_path / "map.zip", tmp_path / "deep" / "copy")
    (root / "notes.txt").unlink()
    assert tree(tmp_path / "deep" / "copy") == tree(root)
    empty = tmp_path / "empty"
    empty.mkdir()
    unpack_map(tmp_path / "map.zip", empty)
    assert tree(empty) == tree(root)
    for taken in (root, tmp_path / "map.zip"):
        with pytest.raises(InputError, match="exists; give a new folder"):
            unpack_map(tmp_path / "map.zip", taken)


def test_pack_reads_again_if_another_process_changes_the_map(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = manage.write_archive
    changes = iter("c")

    def late(*args: object) -> None:
        for _ in changes:
            remove_scenes(MapStore.open(root), ["alpha"])
        write(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(manage, "write_archive", late)
    pack_map(root, tmp_path / "map.zip")
    unpack_map(tmp_path / "map.zip", tmp_path / "copy")
    assert names(tmp_path / "copy") == ["beta", "gamma"]


def rezipped(
    source: Path, target: Path, change: Callable[[dict[str, bytes]], None]
) -> Path:
    """An archive with changed entries."""
    with zipfile.ZipFile(source) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    change(entries)
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return target


def test_archives_that_are_no_complete_map_are_refused(
    root: Path, scenes: list[SceneMap], tmp_path: Path, tree: Tree
) -> None:
    packed = tmp_path / "map.zip"
    pack_map(root, packed)
    keyframes = "stages/0001-alpha/keyframes.safetensors"
    scene = "stages/0002-beta/scene.json"
    schema = tmp_path / "schema"
    shutil.copytree(root, schema)
    listed = Manifest.read(schema)
    write_manifest(schema, {**listed.payload, "schema": 99}, [*listed.files], listed)
    foreign = tmp_path / "foreign"
    shutil.copytree(root, foreign)
    (foreign / scene).write_text(json.dumps({"name": ["no", "scene"]}))
    write_manifest(foreign, listed.payload, [*listed.files])

    def of(folder: Path) -> Callable[[dict[str, bytes]], None]:
        return lambda entries: entries.update(
            {n: (folder / n).read_bytes() for n in entries}
        )

    changes: list[tuple[Callable[[dict[str, bytes]], object], str]] = [
        (
            lambda e: e.update({keyframes: e[keyframes][:-1] + b"\0"}),
            "checksum does not match",
        ),
        (lambda e: e.update({scene: b"{}"}), "2 bytes, expected"),
        (lambda e: e.pop(keyframes), "missing"),
        (lambda e: e.pop(MANIFEST), "no manifest.json in it"),
        (lambda e: e.update({MANIFEST: e[MANIFEST][:-9]}), "broken"),
        (lambda e: e.update({"extra.sh": b"x"}), "extra.sh is not in its manifest"),
        (lambda e: e.update({"../evil": b"x"}), "leaves the folder"),
        (of(schema), "schema 99 is not 6; update evercal"),
        (of(foreign), "not a scene that evercal wrote"),
    ]
    before = tree(tmp_path)
    for change, message in changes:
        broken = rezipped(packed, tmp_path / "broken.zip", change)  # type: ignore[arg-type]
        with pytest.raises(InputError, match=message) as refused:
            unpack_map(broken, tmp_path / "copy")
        assert str(refused.value).startswith(str(broken))
        assert "\n" not in str(refused.value)
        assert "unpacking" not in str(refused.value)
        broken.unlink()
    with pytest.raises(InputError, match="when extracted; at most"):
        unpack_map(packed, tmp_path / "copy", ArchiveLimits(bytes=10_000))
    left = tree(tmp_path)
    left.pop(".copy.lock")
    assert left == before
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize("step", ["first", "middle", "last"])
def test_unpacking_that_was_killed_can_be_repeated(
    step: str, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tree: Tree
) -> None:
    pack_map(root, tmp_path / "map.zip")
    killed = tmp_path / ".copy.unpacking"
    shutil.copytree(root, killed)
    if step != "last":
        shutil.rmtree(killed / "stages")
    if step == "first":
        (killed / MANIFEST).unlink()
    unpack_map(tmp_path / "map.zip", tmp_path / "copy")
    assert tree(tmp_path / "copy") == tree(root)
    assert not killed.exists()
