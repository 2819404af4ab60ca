"""Stores that change while they are read, and damaged, foreign or linked ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from evercal.errors import InputError
from evercal.storage import (
    MANIFEST,
    Manifest,
    manifest as module,
    verify,
    write_manifest,
)
from evercal.storage.stages import SCHEMA, StageStore, read_store

from .stores import NETWORK, Tree, add, change_by, opened, texts

pytestmark = pytest.mark.usefixtures("quick_disk")


def test_a_reader_starts_over_if_a_writer_replaces_files(root: Path) -> None:
    writer = opened(root)
    attempts = []

    def read(manifest: Manifest) -> str:
        attempts.append(manifest)
        if len(attempts) == 1:
            change_by("replace", writer)
        stage = manifest.payload["stages"][0]
        return (root / "stages" / stage / "scene.json").read_text()

    assert read_store(root, read) == '"new"'
    assert len(attempts) == 2


def test_verify_starts_over_if_a_writer_was_faster(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = opened(root)
    writes = iter("w")
    read = module.sha256_file

    def interrupted(path: Path) -> str:
        for _ in writes:
            change_by("replace", writer)
        return read(path)

    monkeypatch.setattr(module, "sha256_file", interrupted)
    assert verify(root) == []
    assert texts(root) == ["new", "hall"]


@pytest.mark.parametrize("file", [NETWORK, "stages/0001-kitchen/head.bin"])
def test_damaged_files_are_named(root: Path, file: str) -> None:
    path = root / file
    store = opened(root)
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    damage = f"{path}: checksum does not match, its content was changed"
    with pytest.raises(InputError, match=f"{damage}; restore it"):
        texts(root)
    # The damage is still reported after another stage is added.
    add(store, "attic")
    assert verify(root) == [damage]
    with pytest.raises(InputError, match="checksum"):
        change_by("replace", store)


def test_a_store_whose_file_is_missing_is_not_written(root: Path) -> None:
    store = opened(root)
    (root / "stages/0001-kitchen/head.bin").unlink()
    before = (root / MANIFEST).read_bytes()
    with pytest.raises((InputError, FileNotFoundError), match=r"head\.bin"):
        add(store, "attic")
    assert (root / MANIFEST).read_bytes() == before


OUTSIDE = ("../secret.bin", "/etc/hostname", "stages/../../secret.bin", "", 7, None)
REFUSED: list[tuple[dict[str, object], str]] = [
    ({"schema": SCHEMA - 1}, "learn the scenes again"),
    ({"schema": SCHEMA + 1}, "update evercal"),
    ({"made": "x"}, "'made' in the manifest is not a number"),
    *(({"networks": [name]}, "network .* is not .*; restore it") for name in OUTSIDE),
    *(({"stages": [name]}, "stage .* is not .*; restore it") for name in OUTSIDE),
    *(({"networks": other}, "is not a list") for other in (NETWORK, None, {"a": 1}, 3)),
    *(({"stages": other}, "is not a list") for other in (NETWORK, None, {"a": 1}, 3)),
]


@pytest.mark.parametrize(("change", "message"), REFUSED)
def test_a_manifest_of_another_kind_is_refused(
    root: Path, change: dict[str, object], message: str
) -> None:
    (root.parent / "secret.bin").write_text("secret")
    manifest = Manifest.read(root)
    write_manifest(root, {**manifest.payload, **change}, list(manifest.files))
    with pytest.raises(InputError, match=f"store {root}: .*{message}"):
        texts(root)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        add(StageStore(tmp_path / "file" / "store", None), "kitchen")


@pytest.mark.parametrize("linked", ["stages", "stages/0002-hall"])
def test_folders_that_are_links_are_never_changed(
    root: Path, tmp_path: Path, linked: str, tree: Tree
) -> None:
    elsewhere = tmp_path / "elsewhere"
    (root / linked).rename(elsewhere)
    (root / linked).symlink_to(elsewhere)
    (elsewhere / "mine.txt").write_text("of another program")
    journal = '{"new": ["0001-kitchen"], "dropped": ["0002-hall"]}'
    (root / ".writing").write_text(journal)
    for _ in range(2):
        before = tree(tmp_path)
        with pytest.raises(InputError, match="is a link; copy the whole map instead"):
            add(opened(root), "attic")
        assert tree(tmp_path) == before
        (root / MANIFEST).unlink(missing_ok=True)
