"""A map whose checksums are right and whose contents are not is refused when it is read."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from evercal.errors import InputError
from evercal.mapping.manage import pack_map, unpack_map
from evercal.mapping.scene_map import SceneMap
from evercal.mapping.store import KEYFRAMES, SCENE, MapStore, stored_scenes
from evercal.storage.manifest import MANIFEST, Manifest, write_manifest
from evercal.storage.tensors import load_tensors, save_tensors

Make = Callable[[Path, Sequence[SceneMap]], MapStore]
Arrays = dict[str, np.ndarray]
STAGE = "stages/0001-alpha"


def rewritten(root: Path, payload: dict[str, Any], files: Sequence[str] = ()) -> None:
    """Write a manifest with right checksums."""
    before = Manifest.read(root)
    write_manifest(root, before.payload | payload, [*before.files, *files])


def with_arrays(root: Path, change: Callable[[Arrays], object]) -> None:
    file = root / STAGE / KEYFRAMES
    arrays = {name: value.copy() for name, value in load_tensors(file).items()}
    change(arrays)
    save_tensors(file, arrays)
    rewritten(root, {})


def with_scene(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    file = root / STAGE / SCENE
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    rewritten(root, {})


def other_images(arrays: Arrays, image: bytes) -> None:
    arrays["images"] = np.frombuffer(image * 2, np.uint8)
    arrays["lengths"] = np.array([len(image)] * 2)


def jpeg(height: int, width: int) -> bytes:
    return cv2.imencode(".jpg", np.zeros((height, width), np.uint8))[1].tobytes()


def without_landmarks(arrays: Arrays) -> None:
    arrays["landmark_counts"][:] = 0
    for name in list(arrays):
        if name.startswith("landmark_") and name != "landmark_counts":
            arrays[name] = arrays[name][:0]


ARRAYS: dict[str, Callable[[Arrays], object]] = {
    "no image": lambda a: other_images(a, b"no image"),
    "keyframe 0: .65, 48. pixels, its camera .64, 48.": lambda a: other_images(
        a, jpeg(48, 65)
    ),
    "keyframe 0 .1000000000x48": lambda a: a["cameras"].__setitem__((0, 0), 1e9),
    "longer than wide": lambda a: a["cameras"].__setitem__((0, 0), 3999),
    "descriptors .2, 64. of width 128": lambda a: a.update(
        descriptors=a["descriptors"][:, :64]
    ),
    "parts of .1, 2. keyframes": lambda a: a.update(descriptors=a["descriptors"][:1]),
    "descriptors: numbers are below": lambda a: a["descriptors"].fill(np.nan),
    "parts of .1, 2. keyframe": lambda a: a.update(poses=a["poses"][:1]),
    "keyframe 0: no depths": lambda a: a["inverse_depth"].fill(0),
    "depths: numbers are below": lambda a: a["inverse_depth"].__setitem__(3, np.nan),
    "47 depths of 6x8 cells": lambda a: a.update(
        cells=np.array([47, 49]),
    ),
    "a scene has landmarks": without_landmarks,
    "landmarks lie in their images": lambda a: a["landmark_pixels"].fill(64),
    "landmarks have depths": lambda a: a["landmark_sigma"].fill(0),
    "landmarks have dept": lambda a: a["landmark_inverse_depth"].fill(-1),
}
SCENES: dict[str, Callable[[dict[str, Any]], object]] = {
    "camera .1000000000x48": lambda s: s["camera"].update(width=10**9),
    "base_covariance is a covariance .6, 6.": lambda s: s["frame"].update(
        base_covariance=[[1.0]]
    ),
    "is a covariance": lambda s: s["frame"].update(
        base_covariance=(-np.eye(6)).tolist()
    ),
    "frame: numbers are below": lambda s: s["frame"].update(pose_sigma=[1e999, 0]),
    "scale and sigma are positive": lambda s: s["frame"].update(scale=0),
    "sigma are positive": lambda s: s["frame"].update(pose_sigma=[-1, 0]),
    "camera: numbers are below": lambda s: s["adjusted_camera"].update(fx=1e300),
    "unit: numbers are below": lambda s: s.update(unit=1e999, metric=False),
    "TypeError": lambda s: s.update(train_frames="many"),
}
PAYLOADS: list[tuple[dict[str, Any], str]] = [
    *(({"short_side": side}, "'short_side'") for side in (0, 1, 100_000, 48.0)),
    ({"networks": []}, "no encoder"),
]


def refused_everywhere(root: Path, message: str) -> None:
    """Opening, listing, packing and unpacking name the folder or file, in one line."""
    with pytest.raises(InputError, match=message) as error:
        MapStore.open(root)
    assert "\n" not in str(error.value)
    assert str(root) in str(error.value)


@pytest.mark.parametrize("message", ARRAYS)
def test_arrays_that_contradict_each_other(root: Path, message: str) -> None:
    with_arrays(root, ARRAYS[message])
    refused_everywhere(root, message)


@pytest.mark.parametrize("message", SCENES)
def test_settings_of_a_scene_that_cannot_be(root: Path, message: str) -> None:
    with_scene(root, SCENES[message])
    refused_everywhere(root, message)


@pytest.mark.parametrize(("payload", "message"), PAYLOADS)
def test_settings_of_a_map_that_cannot_be(
    root: Path, payload: dict[str, Any], message: str
) -> None:
    rewritten(root, payload)
    refused_everywhere(root, message)
    with pytest.raises(InputError, match=message):
        stored_scenes(root)


@pytest.mark.parametrize("name", ["evil.py", f"{STAGE}/notes.txt", ".writing"])
def test_what_is_not_a_maps_does_not_stay_in_it(
    root: Path, tmp_path: Path, name: str
) -> None:
    (root / name).write_text("text")
    rewritten(root, {}, [name])
    message = f"{name} in the manifest is no file of a map"
    refused_everywhere(root, message)
    with pytest.raises(InputError, match=message):
        pack_map(root, tmp_path / "map.zip")


def test_a_name_twice_is_refused(
    scenes: list[SceneMap], tmp_path: Path, make: Make
) -> None:
    store = make(tmp_path / "map", scenes[:2])
    with pytest.raises(InputError, match="has a scene of this name"):
        store.commit(scenes[0], {})
    assert MapStore.open(tmp_path / "map").contents.names == ["alpha", "beta"]
    second = tmp_path / "map" / "stages/0002-beta" / SCENE
    content = json.loads(second.read_text())
    second.write_text(json.dumps({**content, "name": "alpha"}))
    rewritten(tmp_path / "map", {})
    for read in (MapStore.open, stored_scenes):
        with pytest.raises(InputError, match="'alpha' comes twice"):
            read(tmp_path / "map")


@pytest.mark.parametrize("entry", [{"bytes": 9.0}, {"bytes": "9"}, {"sha256": None}])
def test_the_types_of_a_manifest_are_checked(root: Path, entry: dict[str, Any]) -> None:
    before = Manifest.read(root)
    records = {name: record | entry for name, record in before.files.items()}
    changed = replace(before, files=records)
    write_manifest(root, before.payload, [*before.files], changed)
    refused_everywhere(root, "is not its sha256 and bytes")


def test_a_report_that_is_no_object_is_named(root: Path) -> None:
    (root / STAGE / "report.json").write_text("[]")
    rewritten(root, {})
    for read in (stored_scenes, lambda path: MapStore.open(path).reports()):
        with pytest.raises(InputError, match=r"report\.json: holds no JSON object"):
            read(root)


@pytest.mark.parametrize("file", ["encoder", "report.json", SCENE])
def test_an_archive_of_a_map_that_no_command_reads(
    root: Path, tmp_path: Path, file: str
) -> None:
    path = next(root.glob("encoder*"))
    if file != "encoder":
        path = root / STAGE / file
    path.write_bytes(b"[]")
    rewritten(root, {})
    pack_map(root, tmp_path / "map.zip")
    with pytest.raises(InputError, match=r"map\.zip: "):
        unpack_map(tmp_path / "map.zip", tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_a_scene_without_files_is_named(root: Path) -> None:
    before = Manifest.read(root)
    stages = [*before.payload["stages"], "0009-none"]
    write_manifest(root, {**before.payload, "stages": stages}, [*before.files])
    refused_everywhere(root, "0009-none/scene.json: is missing")


def test_a_manifest_is_read_before_anything_is_extracted(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pack_map(root, tmp_path / "map.zip")
    size = (root / MANIFEST).stat().st_size
    monkeypatch.setenv("EVERCAL_LIMITS", f"manifest_bytes={size - 1}")
    with pytest.raises(InputError, match=f"{MANIFEST} has .* at most"):
        unpack_map(tmp_path / "map.zip", tmp_path / "copy")
    with pytest.raises(InputError, match=f"bytes, at most {size - 1:,} are read"):
        MapStore.open(root)
    assert not (tmp_path / "copy").exists()
    assert not list(tmp_path.glob(".copy.unp*"))
