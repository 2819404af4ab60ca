"""Changes that other processes make to the map are noticed."""

from __future__ import annotations

import json
import logging
import shutil
import threading
import time

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.map import Map
from evercal.service.live_map import LiveMap
from evercal.storage.manifest import MANIFEST, Manifest, write_manifest
from evercal.storage.tensors import load_tensors, save_tensors


def test_changes_by_other_processes_are_noticed(serve, copy, image):
    with serve(copy) as service:
        assert service.post("/localize", image=image).json["scene"] == "hall"
        Map.open(copy).rename("hall", "lobby")
        until = time.monotonic() + 10
        while service.get("/scenes").json["scenes"] != ["lobby"]:
            assert time.monotonic() < until
            time.sleep(0.05)
        assert service.post("/localize", image=image).json["scene"] == "lobby"
        (copy / "manifest.json").write_text("{")
        time.sleep(0.7)
        assert service.post("/localize", image=image).json["scene"] == "lobby"


def test_no_answer_mixes_two_states(serve, copy, image, tmp_path):
    """A scene of the same place under two names replaces itself while images are located."""
    with serve(copy) as service:
        expected = service.post("/localize", image=image).json["base_from_camera"]
        stop = threading.Event()

        def rename() -> None:
            names = ["hall", "lobby"]
            while not stop.is_set():
                Map.open(copy).rename(*names)
                service.service.live.refresh()
                names.reverse()

        changing = threading.Thread(target=rename)
        changing.start()
        try:
            rows = [service.post("/localize", image=image).json for _ in range(10)]
        finally:
            stop.set()
            changing.join()
        assert {row["scene"] for row in rows} <= {"hall", "lobby"}
        assert all(row["base_from_camera"] == expected for row in rows)


def test_a_service_without_a_map_waits_for_its_first_scene(
    serve, tmp_path, hall_store, image
):
    with serve(tmp_path / "new") as service:
        assert service.get("/scenes").json == {"scenes": []}
        got = service.post("/localize", image=image)
        assert got.status == 503
        assert "no scene learned yet" in got.json["error"]
        assert not (tmp_path / "new").exists()
        Map.open(tmp_path / "new").merge(hall_store)
        service.service.live.refresh()
        assert service.post("/localize", image=image).json["scene"] == "hall"


def test_a_folder_that_is_away_for_a_moment_is_a_fault(serve, copy, image, caplog):
    with serve(copy) as service, caplog.at_level(logging.WARNING, "evercal"):
        live = service.service.live
        for away in (copy, copy / MANIFEST):
            caplog.clear()
            aside = away.rename(copy.parent / "aside")
            for _ in range(3):
                assert live.refresh() or live.fault
                got = service.post("/localize", image=image)
                assert got.json["scene"] == "hall"
            health = service.get("/health")
            assert health.status == 200
            assert health.json["scenes"] == 1
            assert "its last state is served" in health.json["status"]
            assert [record.message for record in caplog.records] == [
                f"{copy}: the map is gone; mount or restore it; the last state is served"
            ]
            aside.rename(away)
            live.refresh()
            assert service.get("/health").json == {"status": "ok", "scenes": 1}


def test_a_folder_that_vanishes_while_it_is_opened(copy, monkeypatch):
    live = LiveMap(copy)
    Map.open(copy).rename("hall", "lobby")
    opened = Map.open

    def away(path):
        copy.rename(copy.parent / "aside")
        return opened(path)

    monkeypatch.setattr(Map, "open", away)
    assert live.refresh()
    assert live.current.scenes == ("hall",)
    assert "no such folder" in str(live.fault)


def test_a_folder_that_vanishes_before_its_first_scene(serve, tmp_path, image):
    folder = tmp_path / "map"
    folder.mkdir()
    with serve(folder) as service:
        error = service.post("/localize", image=image).json["error"]
        assert "no scene learned yet" in error
        folder.rmdir()
        service.service.live.refresh()
        gone = f"{folder}: the map is gone; mount or restore it"
        assert service.post("/localize", image=image).refusal == (503, gone)
        health = service.get("/health")
        assert health.status == 503
        assert health.json == {"status": "the map cannot be read", "scenes": 0}
    with pytest.raises(InputError, match="the map is gone"):
        LiveMap(folder, known=True)


@pytest.mark.parametrize("wrong", ["images", "descriptors", "inverse_depth"])
def test_wrong_contents_with_right_checksums_are_not_served(copy, wrong, hall, caplog):
    live = LiveMap(copy)
    good = live.current
    (file,) = copy.glob("stages/*/keyframes.safetensors")
    tensors = load_tensors(file)
    if wrong == "images":
        tensors[wrong] = np.zeros_like(tensors[wrong])
    elif wrong == "descriptors":
        tensors[wrong] = tensors[wrong][:, 1:]
    else:
        tensors[wrong] = tensors[wrong][:-1]
        tensors["cells"] = tensors["cells"].copy()
        tensors["cells"][-1] -= 1
        first = tensors["cells"][0]
        tensors["cells"][0], tensors["cells"][-1] = tensors["cells"][-1], first
    before = Manifest.read(copy)
    save_tensors(file, tensors)
    write_manifest(copy, before.payload, list(before.files))
    assert live.refresh()
    assert not live.refresh()  # it is not tried again at once
    assert live.current is good
    assert live.localizer.localize(hall.test[7].read_image()).status == "ok"
    (line,) = [record.message for record in caplog.records]
    assert line.endswith("; the last state is served")
    assert line.startswith(str(copy))


def test_files_that_arrive_after_the_manifest(copy, tmp_path, hall_store, monkeypatch):
    """As copied by a program that knows nothing of manifests."""
    live = LiveMap(tmp_path / "new")
    (tmp_path / "new").mkdir()
    shutil.copy(copy / MANIFEST, tmp_path / "new")
    live.refresh()
    assert "missing" in str(live.fault)
    shutil.copytree(copy, tmp_path / "new", dirs_exist_ok=True, copy_function=copied)
    assert not live.refresh()
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 5.1)
    assert live.refresh()
    assert live.fault is None
    assert live.current.scenes == ("hall",)


def copied(source: str, target: str) -> str:
    """Copy a file unless it is the manifest."""
    if source.endswith(MANIFEST):
        return target
    return shutil.copy2(source, target)


def test_a_file_that_is_overwritten_in_place_heals(serve, copy, image):
    (file,) = copy.glob("stages/*/keyframes.safetensors")
    content = file.read_bytes()
    with serve(copy) as service:
        file.write_bytes(content[:2000])
        got = service.post("/localize", image=image)
        assert got.status == 503
        assert "overwritten in place" in got.json["error"]
        file.write_bytes(content)
        until = time.monotonic() + 10
        while (got := service.post("/localize", image=image)).status != 200:
            assert time.monotonic() < until
            time.sleep(0.05)
        assert got.json["scene"] == "hall"
        assert json.loads(service.get("/health").body)["status"] == "ok"
