"""A store comes back as it was written, and opens whatever the moment it was killed at."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual.networks.head import Head
from evercal.errors import InputError
from evercal.features import vlad
from evercal.features.encoder import load_encoder
from evercal.geometry.se3 import SE3, pose_distance
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_maps import Alignment, SceneMaps
from evercal.mapping.stage_files import head_bytes
from evercal.mapping.store import Checkpoint, Store
from evercal.recordings.frame import Recording
from evercal.storage.manifest import MANIFEST, verify, write_manifest

Stages = dict[str, list[SceneMaps]]
Make = Callable[[Path, list[SceneMaps]], Store]
Tree = Callable[[Path], dict[str, str]]
Answers = Callable[..., list[bytes]]


def stored(head: Head) -> dict[str, Tensor]:
    """What a head is after half precision, but for its centres."""
    return {
        name: value if name == "centres" or not value.is_floating_point() else value.half().float()
        for name, value in head.state_dict().items()
    }


@pytest.mark.parametrize("strategy", ["evercal", "evercal_network", "isolation"])
def test_what_is_committed_is_what_opens(
    strategy: str, taught: Stages, tmp_path: Path, make: Make
) -> None:
    stages = taught[strategy]
    store, maps = make(tmp_path / "store", stages), stages[-1]
    opened = Store.open(tmp_path / "store")
    assert opened.stages == store.stages
    again = opened.maps
    assert (again.strategy, again.short_side) == (maps.strategy, maps.short_side)
    assert len(again.heads) == len(maps.heads)
    for a, b in zip(again.heads, maps.heads, strict=True):
        assert a.options == b.options
        assert not a.training
        state = stored(b)
        assert a.state_dict().keys() == state.keys()
        assert all(torch.equal(value, state[name]) for name, value in a.state_dict().items())
    for a, b in zip(again.scenes, maps.scenes, strict=True):
        assert torch.equal(a.prototypes, b.prototypes)
        np.testing.assert_allclose(a.common.matrix(), b.common.matrix(), atol=1e-12)
        others = [f.name for f in fields(a) if f.name not in ("prototypes", "common")]
        assert [getattr(a, name) for name in others] == [getattr(b, name) for name in others]
    for a, b in zip(again.keyframes, maps.keyframes, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert (a.images, a.cameras) == (b.images, b.cameras)
            poses = a.base_from_camera, b.base_from_camera
            np.testing.assert_allclose(poses[0].matrix(), poses[1].matrix(), atol=1e-15)
            one, two = a.to_tensors(), b.to_tensors()
            assert one.keys() == two.keys()
            assert bool(a.landmarks) == (strategy == "evercal")
            for name, value in one.items():
                if name != "poses":
                    assert torch.equal(value, two[name])
    grey = torch.rand(1, 1, 48, 64, generator=torch.Generator().manual_seed(0))
    for name in ("encoder", "descriptor"):
        a, b = getattr(again, name), getattr(maps, name)
        x = grey if name == "encoder" else maps.encoder(grey)
        torch.testing.assert_close(a(x), b(x), rtol=0, atol=1e-6)


@pytest.mark.parametrize("strategy", ["evercal", "evercal_network"])
def test_everything_can_be_opened_and_written_again_without_a_change(
    strategy: str, taught: Stages, tmp_path: Path, make: Make, tree: Tree
) -> None:
    make(tmp_path / "a", taught[strategy][:1])
    make(tmp_path / "b", [Store.open(tmp_path / "a").maps])
    a, b = tree(tmp_path / "a"), tree(tmp_path / "b")
    assert a.keys() == b.keys()
    # Quaternions are normalised on entry, which may change their last bit.
    changed = {Path(name).name for name in a if a[name] != b[name]}
    assert changed <= {"memory.safetensors", MANIFEST}


def test_poses_survive_the_disk(
    arc_maps: tuple[SceneMaps, SceneMaps],
    arcs: tuple[Recording, Recording],
    tmp_path: Path,
    make: Make,
) -> None:
    make(tmp_path / "store", list(arc_maps))
    before, after = Localizer(arc_maps[1]), Localizer.open(tmp_path / "store")
    assert after.scenes == ("one", "two")
    sure = 0
    for frame in (*arcs[0].test[::4], *arcs[1].test[::4]):
        a, b = (one.localize(frame.read_image(), frame.camera) for one in (before, after))
        if a.inlier_ratio < 0.3 or a.base_from_camera is None:
            continue  # a pose that hangs by a thread may fall either way
        sure += 1
        assert (a.status, a.scene) == (b.status, b.scene)
        assert b.base_from_camera is not None
        metres, radians = pose_distance(a.base_from_camera, b.base_from_camera)
        assert metres < 0.05  # the head's weights were rounded to half precision
        assert radians < np.deg2rad(1)
    assert sure >= 6


@pytest.mark.parametrize(
    ("strategy", "heads"), [("evercal", []), ("evercal_network", [3]), ("isolation", [1, 2, 3])]
)
def test_only_heads_that_count_are_kept(
    strategy: str, heads: list[int], taught: Stages, tmp_path: Path, make: Make
) -> None:
    make(tmp_path, taught[strategy])
    found = sorted(path.parent.name[:4] for path in tmp_path.rglob("head.safetensors"))
    assert found == [f"{number:04d}" for number in heads]
    assert not (tmp_path / "learning").exists()
    assert verify(tmp_path) == []


def test_sizes_are_those_on_disk(taught: Stages, tmp_path: Path, make: Make, tree: Tree) -> None:
    store = make(tmp_path, taught["evercal_network"])
    listed = [tmp_path / name for name in tree(tmp_path)]
    memory = [path.stat().st_size for path in listed if path.name == "memory.safetensors"]
    assert store.bytes() == {
        "memory": sum(memory),
        "rest": sum(path.stat().st_size for path in listed) - sum(memory),
    }
    head = next(tmp_path.rglob("head.safetensors")).stat().st_size
    counted = head_bytes(store.maps.heads[0])
    assert counted < head < counted + 3000  # the file adds only its header
    shutil.copytree(tmp_path / "stages" / store.stages[0], tmp_path / "stages" / "0009-stray")
    before = store.bytes()
    (tmp_path / "stages" / "0009-stray" / "memory.safetensors").write_bytes(bytes(10_000))
    assert store.bytes() == before


def test_any_name_of_a_scene_will_do(taught: Stages, tmp_path: Path, make: Make) -> None:
    for name in ("../../etc", "a/b", "..", ".", "Küche 2", "x" * 300, 'a"b\nc', ""):
        first = taught["evercal_network"][0]
        maps = replace(first, scenes=[replace(first.scenes[0], name=name)])
        root = tmp_path / "deep" / "store"
        make(root, [maps])
        assert Store.open(root).maps.scenes[0].name == name
        assert list(tmp_path.iterdir()) == [tmp_path / "deep"]
        assert list((tmp_path / "deep").iterdir()) == [root]
        shutil.rmtree(root)


@pytest.mark.parametrize(("strategy", "more"), [("evercal", "vlad"), ("evercal_network", "head")])
def test_every_flipped_byte_is_refused_by_name(
    strategy: str, more: str, taught: Stages, tmp_path: Path, make: Make, tree: Tree
) -> None:
    root = tmp_path / "store"
    make(root, taught[strategy][:2])
    names = list(tree(root))
    # Two networks; camera, prototypes and report twice, memory twice, the manifest; and one more.
    assert len(names) == 2 + 2 * 4 + 1 + 1
    assert sum(Path(name).name.startswith(more) for name in names) == 1
    rng = np.random.default_rng(0)
    for name in names:
        file = root / name
        whole = file.read_bytes()
        flipped = bytearray(whole)
        flipped[int(rng.integers(len(whole)))] ^= 1 << int(rng.integers(8))
        for broken in (bytes(flipped), whole[:-2], whole + b"\0", b""):
            file.write_bytes(broken)
            with pytest.raises(InputError, match=Path(name).name):
                Store.open(root)
        file.unlink()
        with pytest.raises(InputError, match=Path(name).name):
            Store.open(root)
        file.write_bytes(whole)
    Store.open(root)


def test_what_is_not_a_store_is_refused(tmp_path: Path, tree: Tree) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("x")
    (tmp_path / "stages").mkdir()  # has the right name, but no learning was going on beside it
    (tmp_path / "mixed" / "learning").mkdir(parents=True)
    (tmp_path / "mixed" / "thesis.tex").write_text("x")
    before = tree(tmp_path)
    for name in ("file", "photos", "missing", "stages", "mixed", ""):
        with pytest.raises(InputError, match=str(tmp_path / name)):
            Store.open(tmp_path / name)
    for name in ("file", "photos", "mixed", ""):
        with pytest.raises(InputError, match="not an evercal store"):
            Store.create(tmp_path / name, "evercal_network")
    Store.create(tmp_path / "new", "evercal_network")
    assert tree(tmp_path) == before
    assert not (tmp_path / "new").exists()


def changed(root: Path, **change: object) -> None:
    """Writes the manifest anew with something else in its payload."""
    manifest = json.loads((root / MANIFEST).read_text())
    write_manifest(root, manifest["payload"] | change, list(manifest["files"]))


def test_a_store_of_another_version_is_refused(taught: Stages, tmp_path: Path, make: Make) -> None:
    make(tmp_path, taught["evercal_network"][:1])
    changed(tmp_path, schema=4)
    with pytest.raises(InputError, match=r"schema 4 .*update evercal"):
        Store.open(tmp_path)


def test_a_store_of_an_earlier_version_is_to_be_learned_again(
    taught: Stages, tmp_path: Path, make: Make, tree: Tree
) -> None:
    make(tmp_path, taught["evercal_network"][:1])
    changed(tmp_path, schema=1)
    before = tree(tmp_path)
    again = "schema 1 is of an earlier evercal; learn the scenes again into a new store"
    with pytest.raises(InputError, match=again) as refusal:
        Store.open(tmp_path)
    assert str(tmp_path) in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert tree(tmp_path) == before


@pytest.mark.parametrize(
    ("strategy", "heads"), [("evercal", 0), ("evercal_network", 1), ("isolation", 3)]
)
def test_a_store_opens_whatever_its_strategy_is_called(
    strategy: str,
    heads: int,
    taught: Stages,
    tmp_path: Path,
    make: Make,
    answers: Answers,
) -> None:
    make(tmp_path, taught[strategy])
    expected = answers(Store.open(tmp_path).maps)
    changed(tmp_path, strategy="of the future")
    maps = Store.open(tmp_path).maps
    assert maps.strategy == "of the future"
    assert len(maps.heads) == heads
    assert answers(maps) == expected


def test_two_stores_share_nothing(
    taught: Stages, tmp_path: Path, make: Make, tree: Tree, answers: Answers
) -> None:
    stages = taught["evercal_network"]
    a, b = make(tmp_path / "a", stages[:1]), make(tmp_path / "b", stages[:1])
    before = tree(tmp_path / "b")
    a.begin({"scene": "beta"})
    a.commit(stages[1], {})
    shutil.rmtree(tmp_path / "a")
    assert tree(tmp_path / "b") == before
    assert b.stages == ["0001-alpha"]
    one, two = (Store.open(tmp_path / "b").maps for _ in range(2))
    expected = answers(two)
    with torch.no_grad():
        for parameter in (*one.heads[0].parameters(), one.scenes[0].prototypes):
            parameter.zero_()
    assert answers(two) == expected
    assert answers(one, sure=False) != expected


def test_what_the_manifest_does_not_list_does_not_count(
    taught: Stages, tmp_path: Path, make: Make, answers: Answers
) -> None:
    make(tmp_path, taught["evercal_network"][:1])
    expected = answers(Store.open(tmp_path).maps)
    stage = tmp_path / "stages" / "0001-alpha"
    strays = [tmp_path / "notes.txt", stage / ".DS_Store", tmp_path / "stages" / "README"]
    for stray in strays:
        stray.write_text("x")
    shutil.copytree(stage, tmp_path / "stages" / "0002-ghost")
    store = Store.open(tmp_path)
    assert answers(store.maps) == expected
    store.begin({"scene": "beta"})
    store.commit(taught["evercal_network"][1], {})
    for stray in strays:  # still the user's, and still nothing to us
        assert stray.read_text() == "x"
        stray.write_text("changed")
    assert Store.open(tmp_path).stages == ["0001-alpha", "0002-beta"]
    assert not (tmp_path / "stages" / "0002-ghost").exists()


def test_checkpoints_come_back_to_the_same_stage_only(
    taught: Stages, tmp_path: Path, make: Make
) -> None:
    store = make(tmp_path, taught["evercal_network"][:1])
    asked = {"scene": "beta", "options": {"seed": 0, "size": (1, 2)}}
    assert store.begin(asked) is None
    assert Store.open(tmp_path).begin(asked) is None  # begun, but nothing done yet
    rows = [{"x": torch.arange(i, i + 3)} for i in range(12)]
    for part in rows:
        store.checkpoint(Checkpoint(part, {}))
    store.checkpoint(Checkpoint({}, {"step": torch.tensor(4)}))
    store.checkpoint(Checkpoint({}, {"step": torch.tensor(7)}))
    for _ in range(2):
        found = Store.open(tmp_path).begin(asked)
        assert found is not None
        assert len(found.rows) == 12
        for a, b in zip(found.rows, rows, strict=True):
            assert torch.equal(a["x"], b["x"])
        assert int(found.trainer["step"]) == 7
    assert store.begin({**asked, "scene": "gamma"}) is None
    assert store.begin(asked) is None


@pytest.mark.parametrize("index", [0, 2])
def test_a_record_is_replaced_and_nothing_else(
    index: int, taught: Stages, tmp_path: Path, make: Make
) -> None:
    root = tmp_path / "store"
    before = make(root, taught["evercal"])
    record = before.maps.scenes[index]
    moved = replace(
        record,
        alignment=Alignment(SE3.exp([1.0, 2, 3, 0.1, 0.2, 0.3]), 1.5),
        frame_covariance=np.diag(np.arange(1.0, 7.0)) * 1e-6,
    )
    for _ in range(2):  # a second time too: nothing of the first is left
        Store.open(root).replace_record(record.name, moved)
    assert verify(root) == []
    opened = Store.open(root)
    assert [scene.name for scene in opened.maps.scenes] == [s.name for s in before.maps.scenes]
    found = opened.maps.scenes[index]
    assert found.alignment is not None
    assert found.alignment.scale == 1.5
    assert found.frame_covariance == pytest.approx(moved.frame_covariance)
    assert opened.maps.scenes[1].alignment is None
    assert len(list((root / "stages").iterdir())) == 3
    kept = opened.maps.keyframes[index]
    original = before.maps.keyframes[index]
    assert kept is not None
    assert original is not None
    assert kept.images == original.images


def test_centroids_of_another_encoder_stay_with_the_store(
    taught: Stages, tmp_path: Path, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = taught["evercal"]
    make(tmp_path, stages[:1])
    listed = list(json.loads((tmp_path / MANIFEST).read_text())["files"])
    with monkeypatch.context() as patch:
        patch.setattr(vlad, "fit_centroids", None)  # nothing is fitted
        opened = vlad.vlad_for(Store.open(tmp_path).maps.encoder)
    assert torch.equal(opened.centroids, vlad.vlad_for(stages[0].encoder).centroids)
    # One that was made without them opens too, and gets them with its next scene.
    (file,) = tmp_path.glob("vlad-*.safetensors")
    file.unlink()
    payload = json.loads((tmp_path / MANIFEST).read_text())["payload"]
    del payload["centroids"]
    write_manifest(tmp_path, payload, [name for name in listed if name != file.name])
    store = Store.open(tmp_path)
    store.commit(stages[1], {})
    assert file.exists()
    assert verify(tmp_path) == []


def test_centroids_that_are_shipped_are_not_stored(
    taught: Stages, tmp_path: Path, make: Make
) -> None:
    make(tmp_path, [replace(taught["evercal"][0], encoder=load_encoder())])
    assert not list(tmp_path.glob("vlad-*"))
