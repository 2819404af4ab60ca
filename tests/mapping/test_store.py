"""A store contains what was committed, and damaged or foreign files are refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.features.encoder import load_encoder
from evercal.geometry.se3 import SE3
from evercal.mapping.map_frame import FrameCorrection, MapFrame, Similarity
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.mapping.store import MapStore, read_scene, stored_scenes
from evercal.storage.manifest import MANIFEST, Manifest, verify, write_manifest

Make = Callable[[Path, Sequence[SceneMap]], MapStore]
Tree = Callable[[Path], dict[str, str]]
Contents = Callable[[MapContents], list[object]]


def test_opened_map_equals_committed_map(
    scenes: list[SceneMap], tmp_path: Path, make: Make, content: Contents
) -> None:
    store = make(tmp_path / "store", scenes)
    opened = MapStore.open(tmp_path / "store")
    assert (opened.stages, opened.contents.short_side) == (store.stages, 48)
    assert content(opened.contents) == content(
        MapContents(store.contents.encoder, 48, scenes)
    )
    assert opened.reports() == [
        {"scene": scene.name, "seconds": 1.5} for scene in scenes
    ]
    grey = np.random.default_rng(0).integers(0, 256, (48, 64)).astype(np.uint8)
    expected = store.contents.encoder(grey)
    np.testing.assert_array_equal(opened.contents.encoder(grey), expected)


def test_writing_an_opened_map_changes_nothing(
    scenes: list[SceneMap], tmp_path: Path, make: Make, tree: Tree
) -> None:
    make(tmp_path / "a", scenes[:1])
    make(tmp_path / "b", MapStore.open(tmp_path / "a").contents.scenes)
    a = tree(tmp_path / "a")
    b = tree(tmp_path / "b")
    assert a.keys() == b.keys()
    changed = {Path(name).name for name in a if a[name] != b[name]}
    # Quaternions are normalised on entry, which may change their last bit.
    assert changed <= {
        "scene.json",
        "keyframes.safetensors",
        "correction.safetensors",
        MANIFEST,
    }


def test_any_scene_name_is_stored(
    scenes: list[SceneMap], tmp_path: Path, make: Make
) -> None:
    for name in ("Küche 2", "x" * 200, 'a"b', "部屋", "a.b:c*?"):
        root = tmp_path / "deep" / "store"
        make(root, [replace(scenes[1], name=name)])
        assert MapStore.open(root).contents.scenes[0].name == name
        assert [path.name for path in tmp_path.iterdir()] == ["deep"]
        assert {path.name for path in root.parent.iterdir()} == {"store"}
        shutil.rmtree(root)


BAD_NAMES = (
    "../../etc", "a/b", "..", "a\nb", "", "x" * 201, "a\x1b[31m", "a\x7f", "a\x9bm", "a\u202eb",
    "a\u2028b", "a\ud800", "a=b",
)  # fmt: skip


@pytest.mark.parametrize("name", BAD_NAMES)
def test_a_name_that_evercal_does_not_give_is_refused(
    name: str, scenes: list[SceneMap], tmp_path: Path, make: Make
) -> None:
    root = make(tmp_path / "store", scenes[:1]).root
    file = root / "stages" / "0001-alpha" / "scene.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "name": name}))
    manifest = Manifest.read(root)
    write_manifest(root, manifest.payload, list(manifest.files))
    for read in (MapStore.open, stored_scenes):
        with pytest.raises(
            InputError, match=r"scene name .*: give one of at most 200"
        ) as error:
            read(root)
        assert str(error.value).isprintable()


def test_every_changed_byte_is_refused_by_file_name(
    scenes: list[SceneMap], tmp_path: Path, make: Make, tree: Tree
) -> None:
    root = tmp_path / "store"
    make(root, scenes[:2])
    names = list(tree(root))
    rng = np.random.default_rng(0)
    # Encoder and centroids; scene, keyframes and report twice; one correction; the manifest.
    assert len(names) == 2 + 2 * 3 + 1 + 1
    for name in names:
        file = root / name
        data = file.read_bytes()
        flipped = bytearray(data)
        flipped[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        for broken in (bytes(flipped), data[:-2], data + b"\0", b""):
            file.write_bytes(broken)
            with pytest.raises(InputError, match=Path(name).name):
                MapStore.open(root)
        file.unlink()
        with pytest.raises(InputError, match=Path(name).name):
            MapStore.open(root)
        file.write_bytes(data)
    MapStore.open(root)


def test_foreign_folders_are_refused(tmp_path: Path, tree: Tree) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("x")
    before = tree(tmp_path)
    for name in ("file", "photos", "missing", ""):
        with pytest.raises(InputError, match=str(tmp_path / name)):
            MapStore.open(tmp_path / name)
    for name in ("file", "photos", ""):
        with pytest.raises(InputError, match="not an evercal store"):
            MapStore.create(tmp_path / name)
    MapStore.create(tmp_path / "new")
    assert tree(tmp_path) == before
    assert not (tmp_path / "new").exists()


def test_stores_of_networks_are_refused(
    scenes: list[SceneMap], tmp_path: Path, make: Make, tree: Tree
) -> None:
    root = tmp_path / "store"
    make(root, scenes[:1])
    change = {"kind": "networks", "strategy": "sars"}
    manifest = json.loads((root / MANIFEST).read_text())
    write_manifest(root, manifest["payload"] | change, list(manifest["files"]))
    before = tree(root)
    with pytest.raises(
        InputError, match=f"{root}.*: holds networks of strategy 'sars'"
    ):
        MapStore.open(root)
    assert tree(root) == before
    write_manifest(
        root, manifest["payload"] | {"short_side": "a"}, list(manifest["files"])
    )
    with pytest.raises(InputError, match="'short_side' in the manifest is 'a'"):
        MapStore.open(root)


def test_unlisted_files_are_ignored(
    scenes: list[SceneMap], tmp_path: Path, make: Make, content: Contents
) -> None:
    expected = content(make(tmp_path, scenes[:1]).contents)
    stage = tmp_path / "stages" / "0001-alpha"
    strays = [tmp_path / "notes.txt", tmp_path / "stages" / "README"]
    for stray in strays:
        stray.write_text("x")
    shutil.copytree(stage, tmp_path / "stages" / "0002-ghost")
    store = MapStore.open(tmp_path)
    assert content(store.contents) == expected
    sizes = store.size_bytes()
    assert (
        sizes["stages/0001-alpha/scene.json"] == (stage / "scene.json").stat().st_size
    )
    assert not any("ghost" in name for name in sizes)
    store.commit(scenes[1], {})
    for stray in strays:
        assert stray.read_text() == "x"
    assert MapStore.open(tmp_path).stages == ["0001-alpha", "0003-beta"]
    assert (tmp_path / "stages" / "0002-ghost").exists()


@pytest.mark.parametrize("index", [0, 2])
def test_update_replaces_one_scene(
    index: int, scenes: list[SceneMap], tmp_path: Path, make: Make, content: Contents
) -> None:
    root = tmp_path / "store"
    make(root, scenes)
    similarity = Similarity(SE3.exp([1.0, 2, 3, 0.1, 0.2, 0.3]), 2.5)
    moved = replace(
        scenes[index], frame=MapFrame(similarity=similarity), train_frames=7
    )
    for _ in range(2):
        MapStore.open(root).update(moved)
    assert verify(root) == []
    expected = [moved if i == index else scene for i, scene in enumerate(scenes)]
    opened = MapStore.open(root)
    assert (
        content(opened.contents)[:2]
        == content(MapContents(load_encoder(), 48, expected))[:2]
    )
    assert opened.contents.scenes[index].frame.similarity is not None
    assert opened.contents.scenes[index].train_frames == 7
    assert len(list((root / "stages").iterdir())) == 3


def test_a_scene_that_could_not_be_read_is_not_written(
    scenes: list[SceneMap], tmp_path: Path, make: Make, tree: Tree
) -> None:
    store = make(tmp_path / "store", scenes[:1])
    before = tree(tmp_path / "store")
    keyframes = scenes[1].keyframes
    far = keyframes.base_from_camera
    far = SE3(far.rotation_wxyz, far.translation_m + 1e6)
    scene = replace(scenes[1], keyframes=replace(keyframes, base_from_camera=far))
    with pytest.raises(InputError, match="poses: numbers are below 1e"):
        store.commit(scene, {})
    assert tree(tmp_path / "store") == before
    assert len(MapStore.open(tmp_path / "store").contents.scenes) == 1


def test_undo_does_not_bring_back_an_earlier_base_frame(
    scenes: list[SceneMap], tmp_path: Path, make: Make
) -> None:
    store = make(tmp_path / "store", scenes[:1])
    store.refresh(scenes[0], {})
    frame = replace(scenes[0].frame, base_covariance=1e-6 * np.eye(6))
    store.update(replace(scenes[0], frame=frame))  # aligned after the refresh
    with pytest.raises(InputError, match="no refresh to undo"):
        store.undo(scenes[0].name)
    with pytest.raises(InputError, match=f"'attic': store .* has {scenes[0].name}"):
        store.undo("attic")
    (stored,) = MapStore.open(tmp_path / "store").contents.scenes
    assert stored.frame.base_covariance is not None
    assert verify(tmp_path / "store") == []


def test_centroids_of_another_encoder_are_stored(
    scenes: list[SceneMap], tmp_path: Path, make: Make
) -> None:
    store = make(tmp_path, scenes[:1])
    expected = store.contents.encoder.centroids
    assert expected is not None
    stored = MapStore.open(tmp_path).contents.encoder.centroids
    np.testing.assert_array_equal(stored, expected)


def test_shipped_centroids_are_not_stored(
    hall_map: MapContents, tmp_path: Path
) -> None:
    store = MapStore.create(tmp_path / "store")
    store.commit(hall_map.scenes[0], {})
    assert not list((tmp_path / "store").glob("vlad-*"))
    MapStore.open(tmp_path / "store")


def test_encoder_file_for_a_stored_map_is_refused(
    scenes: list[SceneMap], tmp_path: Path, make: Make
) -> None:
    make(tmp_path, scenes[:1])
    with pytest.raises(InputError, match="keeps the encoder it was made with"):
        MapStore.open_or_create(tmp_path, Path("encoder.safetensors"))


def test_update_removes_a_correction_that_no_longer_applies(
    hall_map: MapContents, tmp_path: Path
) -> None:
    scene = hall_map.scenes[0]
    poses = scene.keyframes.base_from_camera
    correction = FrameCorrection(poses, np.full((len(poses), 6), 1e-3), (0.1, 0.2))
    corrected = replace(scene, frame=replace(scene.frame, correction=correction))
    store = MapStore.create(tmp_path / "map")
    store.commit(corrected, {})
    assert (
        MapStore.open(tmp_path / "map").contents.scenes[0].frame.correction is not None
    )
    store.update(replace(scene, frame=replace(scene.frame, correction=None)))
    assert MapStore.open(tmp_path / "map").contents.scenes[0].frame.correction is None


def test_scenes_that_state_no_unit_are_in_metres(
    scenes: list[SceneMap], make: Make, tmp_path: Path
) -> None:
    store = make(tmp_path / "map", scenes[:1])
    folder = store.folder(store.stages[0])
    assert read_scene(folder).unit == 1.0
    content = json.loads((folder / "scene.json").read_text())
    del content["metric"]
    (folder / "scene.json").write_text(json.dumps(content))
    assert read_scene(folder).unit is None
