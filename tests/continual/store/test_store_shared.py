"""Several processes and one store: one writes at a time, readers never see half of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from evercal.cli.align import Align
from evercal.errors import InputError
from evercal.geometry.se3 import SE3
from evercal.mapping import store as module
from evercal.mapping.scene_maps import Alignment, SceneMaps, SceneRecord
from evercal.mapping.store import Checkpoint, Store
from evercal.storage import manifest, verify

Stages = dict[str, list[SceneMaps]]
Make = Callable[[Path, list[SceneMaps]], Store]
Tree = Callable[[Path], dict[str, str]]


def moved(store: Store) -> SceneRecord:
    """Another record for the first scene."""
    return replace(store.maps.scenes[0], alignment=Alignment(SE3.exp([1.0, 2, 3, 0, 0, 0])))


@pytest.fixture
def root(taught: Stages, tmp_path: Path, make: Make) -> Path:
    """A store of two scenes."""
    return make(tmp_path / "store", taught["evercal"][:2]).root


def test_nobody_writes_beside_a_learner(root: Path, taught: Stages, tree: Tree) -> None:
    learner, aligner = Store.open(root), Store.open(root)
    with learner.writing():
        learner.begin({"scene": "gamma"})
        before = tree(root)
        with pytest.raises(InputError, match="another process is learning into it"):
            aligner.replace_record("alpha", moved(aligner))
        # Refused before anything is read or calculated.
        with pytest.raises(InputError, match="another process is learning into it"):
            Align(root, "alpha", robot_poses=root / "missing.csv").run()
        assert tree(root) == before
        learner.checkpoint(Checkpoint({"x": torch.zeros(2)}, {}))
        learner.commit(taught["evercal"][2], {})
    assert verify(root) == []
    assert list(root.parent.iterdir()) == [root]
    # Opened before the scene was there, it would write a list without it.
    with pytest.raises(InputError, match="changed it meanwhile"):
        aligner.replace_record("alpha", moved(aligner))
    with pytest.raises(InputError, match="changed it meanwhile"):
        aligner.commit(taught["evercal"][2], {})
    assert len(Store.open(root).stages) == 3


def test_two_that_began_a_store_at_once(taught: Stages, tmp_path: Path, make: Make) -> None:
    late = Store(tmp_path / "store", taught["evercal"][0], [], None)
    make(tmp_path / "store", taught["evercal"][:1])
    with pytest.raises(InputError, match="changed it meanwhile"):
        late.commit(taught["evercal"][0], {})


def test_checkpoints_outlive_another_record(root: Path) -> None:
    store = Store.open(root)
    store.begin({"scene": "gamma"})
    store.checkpoint(Checkpoint({"x": torch.zeros(2)}, {}))
    store.replace_record("alpha", moved(store))
    assert Store.open(root).begin({"scene": "gamma"}) is not None


def test_a_store_has_one_lock_by_whatever_name(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = root.parent / "link" / "other"
    link.parent.mkdir()
    link.symlink_to(root)
    monkeypatch.chdir(root)
    stores = [Store.open(path) for path in (root, link, Path())]
    for store in stores:
        with store.writing():
            for other in stores:
                if other is not store:
                    with pytest.raises(InputError, match="another process"):
                        other.replace_record("alpha", moved(other))
        store.abandon()
    assert verify(root) == []


@pytest.mark.parametrize("index", [0, 1])
def test_a_stage_without_its_files_is_not_listed(
    index: int, root: Path, taught: Stages, tree: Tree
) -> None:
    store = Store.open(root)
    (root / "stages" / store.stages[index] / "memory.safetensors").unlink()
    listed = (root / manifest.MANIFEST).read_bytes()
    with pytest.raises(FileNotFoundError):
        store.commit(taught["evercal"][2], {})
    with pytest.raises(InputError, match=r"memory\.safetensors: missing"):
        store.replace_record("alpha", moved(store))
    assert (root / manifest.MANIFEST).read_bytes() == listed


def test_what_was_damaged_while_a_scene_was_learned_is_noticed(root: Path, taught: Stages) -> None:
    store = Store.open(root)
    file = root / "stages" / store.stages[0] / "memory.safetensors"
    file.write_bytes(file.read_bytes()[:-1] + b"\0")
    store.commit(taught["evercal"][2], {})
    assert verify(root) == [f"{file}: checksum does not match, its content was changed"]


@pytest.mark.parametrize("moment", ["verified", "before a scene", "within a scene"])
def test_a_reader_starts_over_where_a_writer_was_faster(
    moment: str, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer, turns = Store.open(root), iter("w")
    place, name = (manifest, "sha256_file") if moment == "verified" else (module, "read_record")
    whole = getattr(place, name)

    def interrupted(path: Path) -> object:
        found = whole(path) if moment == "within a scene" else None
        for _ in turns:
            writer.replace_record("alpha", moved(writer))
        return found or whole(path)

    monkeypatch.setattr(place, name, interrupted)
    maps = Store.open(root).maps
    assert maps.scenes[0].alignment is not None
    assert None not in maps.keyframes
    turns = iter("w")
    assert verify(root) == []
