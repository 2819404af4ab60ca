"""Maps are packed into one file and unpacked: completely, or not at all."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from evercal.bounds import VARIABLE
from evercal.errors import InputError
from evercal.mapping import manage
from evercal.mapping.manage import pack_map, remove_scenes, unpack_map
from evercal.mapping.store import MapStore
from evercal.storage.manifest import MANIFEST, Manifest, write_manifest

Tree = Callable[[Path], dict[str, str]]


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
    opened = MapStore.open(tmp_path / "copy").contents
    assert opened.names == ["beta", "gamma"]


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
    root: Path, tmp_path: Path, tree: Tree, monkeypatch: pytest.MonkeyPatch
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
        (lambda e: e.update({scene: b"{}"}), "scene.json has 2 bytes, expected"),
        (lambda e: e.pop(keyframes), "has 0 bytes, expected"),
        (lambda e: e.pop(MANIFEST), "no manifest.json in it"),
        (lambda e: e.update({MANIFEST: e[MANIFEST][:-9]}), "broken"),
        (lambda e: e.update({"extra.sh": b"x"}), "extra.sh has 1 bytes, expected 0"),
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
    monkeypatch.setenv(VARIABLE, "archive_bytes=10_000")
    with pytest.raises(InputError, match="bytes when extracted, at most 10,000"):
        unpack_map(packed, tmp_path / "copy")
    left = tree(tmp_path)
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
