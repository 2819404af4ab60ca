"""Several processes and one store: one writes at a time, and readers never see half of it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from evercal.errors import InputError
from evercal.mapping import store as module
from evercal.mapping.scene_map import SceneMap
from evercal.mapping.store import MapStore
from evercal.storage import manifest, verify

Make = Callable[[Path, Sequence[SceneMap]], MapStore]
Tree = Callable[[Path], dict[str, str]]

WRITER = """
import sys
from pathlib import Path
from evercal.storage.stages import StageStore
store = StageStore(Path(sys.argv[1]), ["0001-alpha", "0002-beta"], ())
with store.writing():
    print("writing", flush=True)
    sys.stdin.readline()
"""


def changed(store: MapStore) -> SceneMap:
    """The first scene with another threshold."""
    return replace(store.contents.scenes[0], min_support=0.9)


@pytest.fixture
def root(scenes: list[SceneMap], tmp_path: Path, make: Make) -> Path:
    """A store of two scenes."""
    return make(tmp_path / "store", scenes[:2]).root


def test_two_processes_cannot_write_at_once(root: Path, tree: Tree) -> None:
    """The lock file stays: a process that waits for a removed one would lock a deleted file."""
    store, lock = MapStore.open(root), root.parent / ".store.lock"
    before = tree(root)
    for _ in range(2):
        command = [sys.executable, "-c", WRITER, str(root)]
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as writer:
            assert writer.stdin is not None
            assert writer.stdout is not None
            assert writer.stdout.readline() == "writing\n"
            inode = lock.stat().st_ino
            with pytest.raises(InputError, match="another process is writing into it"):
                store.update(changed(store))
            writer.stdin.write("\n")
        assert writer.returncode == 0
        assert lock.stat().st_ino == inode
    assert tree(root) == before
    store.update(changed(store))
    assert MapStore.open(root).contents.scenes[0].min_support == 0.9


def test_writer_with_an_outdated_list_is_refused(
    root: Path, scenes: list[SceneMap], tmp_path: Path, make: Make
) -> None:
    late = MapStore.open(root)
    MapStore.open(root).commit(scenes[2], {})
    for write in (lambda: late.update(changed(late)), lambda: late.commit(scenes[2], {})):
        with pytest.raises(InputError, match="another process has changed it"):
            write()
    assert len(MapStore.open(root).stages) == 3
    first = MapStore.create(tmp_path / "new")
    make(tmp_path / "new", scenes[:1])
    with pytest.raises(InputError, match="another process has changed it"):
        first.commit(scenes[0], {})


def test_store_has_one_lock_under_all_its_names(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = root.parent / "link" / "other"
    link.parent.mkdir()
    link.symlink_to(root)
    monkeypatch.chdir(root)
    stores = [MapStore.open(path) for path in (root, link, Path())]
    for store in stores:
        with store.writing():
            for other in stores:
                if other is not store:
                    with pytest.raises(InputError, match="another process"):
                        other.update(changed(other))
    assert verify(root) == []


@pytest.mark.parametrize("index", [0, 1])
def test_scene_with_missing_files_is_not_listed_again(
    index: int, root: Path, scenes: list[SceneMap]
) -> None:
    store = MapStore.open(root)
    (root / "stages" / store.stages[index] / "keyframes.safetensors").unlink()
    listed = (root / manifest.MANIFEST).read_bytes()
    with pytest.raises(FileNotFoundError):
        store.commit(scenes[2], {})
    with pytest.raises(InputError, match=r"keyframes\.safetensors: missing"):
        store.update(changed(store))
    assert (root / manifest.MANIFEST).read_bytes() == listed


def test_damage_is_reported_after_another_scene_is_added(
    root: Path, scenes: list[SceneMap]
) -> None:
    store = MapStore.open(root)
    file = root / "stages" / store.stages[0] / "keyframes.safetensors"
    file.write_bytes(file.read_bytes()[:-1] + b"\0")
    store.commit(scenes[2], {})
    assert verify(root) == [f"{file}: checksum does not match, its content was changed"]


@pytest.mark.parametrize("moment", ["checksums", "scene"])
def test_reader_starts_over_if_a_writer_was_faster(
    moment: str, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer, writes = MapStore.open(root), iter("w")
    owner, name = (manifest, "sha256_file") if moment == "checksums" else (module, "read_scene")
    read = getattr(owner, name)

    def interrupted(path: Path) -> object:
        for _ in writes:
            writer.update(changed(writer))
        return read(path)

    monkeypatch.setattr(owner, name, interrupted)
    assert MapStore.open(root).contents.scenes[0].min_support == 0.9
    writes = iter("w")
    assert verify(root) == []
