"""Changes that other processes make to the map are noticed."""

from __future__ import annotations

import threading
import time

from evercal.map import Map


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
        assert got.status == 400
        assert "no scene learned yet" in got.json["error"]
        assert not (tmp_path / "new").exists()
        Map.open(tmp_path / "new").merge(hall_store)
        service.service.live.refresh()
        assert service.post("/localize", image=image).json["scene"] == "hall"
