"""Scenes are learned in another process, noticed, and removed."""

from __future__ import annotations

import io
import json
import os
import signal
import stat
import threading
import time
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from evercal.map import Map
from evercal.service.limits import Limits

if TYPE_CHECKING:
    from evercal.recordings import Recording

ZIP = {"Content-Type": "application/zip"}
JSON = {"Content-Type": "application/json"}


def archive(folder: Path, top: str = "") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as zipped:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            zipped.write(path, Path(top, path.relative_to(folder)))
    return file.getvalue()


def test_a_scene_is_learned_while_images_are_located_and_then_removed(
    serve: Any, copy: Path, image: Path, recording: Path
) -> None:
    with serve(copy) as service:
        got = service.ask("POST", "/scenes?name=attic", body=archive(recording, "x"), headers=ZIP)
        assert got.status == 202
        assert got.headers["location"] == f"/jobs/{got.json['id']}"
        again = service.ask("POST", "/scenes?name=attic", body=b"", headers=ZIP)
        assert (again.status, list(again.json)) == (409, ["error"])
        seen, located = set(), 0
        while (job := service.ask("GET", f"/jobs/{got.json['id']}").json)["status"] in (
            "queued",
            "learning",
        ):
            seen.add(job["step"])
            parts = [("image", (image.name, image.read_bytes()))]
            row = service.ask("POST", "/localize", parts).json
            assert (row["status"], row["scene"]) == ("ok", "hall")
            located += 1
            time.sleep(0.2)
        assert (job["status"], job["error"], job["name"]) == ("done", "", "attic")
        assert job["report"]["scene"] == "attic"
        assert located > 3
        assert "adjusting" in seen
        assert service.ask("GET", "/scenes").json["scenes"] == ["hall", "attic"]
        got = service.ask("DELETE", "/scenes/attic")
        assert (got.status, got.body) == (204, b"")
        assert service.ask("GET", "/scenes").json["scenes"] == ["hall"]
        assert service.ask("DELETE", "/scenes/attic").status == 404
        assert Map.open(copy, device="cpu").scenes == ("hall",)
        assert list(service.service.uploads.iterdir()) == []


def test_changes_by_other_processes_are_noticed(serve: Any, copy: Path, image: Path) -> None:
    parts = [("image", (image.name, image.read_bytes()))]
    with serve(copy) as service:
        assert service.ask("POST", "/localize", parts).json["scene"] == "hall"
        with Map.open(copy, device="cpu")._store.writing():
            got = service.ask("DELETE", "/scenes/hall")
            assert got.status == 409
            assert "another process is writing" in got.json["error"]
        Map.open(copy, device="cpu").rename("hall", "lobby")
        until = time.monotonic() + 10
        while service.ask("GET", "/scenes").json["scenes"] != ["lobby"]:
            assert time.monotonic() < until
            time.sleep(0.05)
        assert service.ask("POST", "/localize", parts).json["scene"] == "lobby"
        (copy / "manifest.json").write_text("{")
        time.sleep(0.7)
        assert service.ask("POST", "/localize", parts).json["scene"] == "lobby"


def test_no_answer_mixes_two_states(serve: Any, copy: Path, image: Path, tmp_path: Path) -> None:
    """A scene of the same place under two names replaces itself while images are located."""
    parts = [("image", (image.name, image.read_bytes()))]
    with serve(copy) as service:
        expected = service.ask("POST", "/localize", parts).json["base_from_camera"]
        stop = threading.Event()

        def rename() -> None:
            names = ["hall", "lobby"]
            while not stop.is_set():
                Map.open(copy, device="cpu").rename(*names)
                service.service.live.refresh()
                names.reverse()

        changing = threading.Thread(target=rename)
        changing.start()
        try:
            rows = [service.ask("POST", "/localize", parts).json for _ in range(25)]
        finally:
            stop.set()
            changing.join()
        assert {row["scene"] for row in rows} <= {"hall", "lobby"}
        assert all(row["base_from_camera"] == expected for row in rows)


def test_recordings_below_the_allowed_folder(
    serve: Any, copy: Path, recording: Path, tmp_path: Path
) -> None:
    secret = tmp_path / "secret"
    secret.mkdir()
    allowed = tmp_path / "allowed"
    allowed.mkdir()
    (allowed / "link").symlink_to(secret)
    (allowed / "empty").mkdir()
    (allowed / "outside").mkdir()
    data = json.loads((recording / "scene.json").read_text())
    (allowed / "outside" / "scene.json").write_text(json.dumps(data))
    (allowed / "outside" / "images").symlink_to(recording / "images")
    with serve(copy, recordings=allowed) as service:
        for path, status in (
            ("../secret", 403), (str(secret), 403), ("link", 403), ("", 403), (".", 403),
            ("missing", 404), ("a\0b", 400), ("x" * 5000, 400),
        ):  # fmt: skip
            body = json.dumps({"path": path}).encode()
            got = service.ask("POST", "/scenes", body=body, headers=JSON)
            assert (got.status, list(got.json)) == (status, ["error"])
            assert str(tmp_path) not in got.json["error"]
        for path, message in (
            ("empty", "empty: no known scene format"),
            ("outside", "outside: image 000000.png lies outside the recording"),
        ):
            body = json.dumps({"path": path, "name": "new"}).encode()
            got = service.ask("POST", "/scenes", body=body, headers=JSON)
            assert got.status == 202
            job = service.job(got.json["id"])
            assert job["status"] == "failed"
            assert job["error"].startswith(message)
            assert str(tmp_path) not in job["error"]
        assert service.ask("GET", "/scenes").json["scenes"] == ["hall"]


def link() -> bytes:
    file, entry = io.BytesIO(), zipfile.ZipInfo("link")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(file, "w") as zipped:
        zipped.writestr(entry, "/etc/passwd")
    return file.getvalue()


def entries(**files: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as zipped:
        for name, data in files.items():
            zipped.writestr(name, data)
    return file.getvalue()


@pytest.mark.parametrize(
    ("path", "body", "headers", "status", "message"),
    [
        ("/scenes", b"no archive", ZIP, 400, "archive: not a zip archive"),
        ("/scenes", entries(**{"../evil": b"x"}), ZIP, 400, "leaves the folder"),
        ("/scenes", link(), ZIP, 400, "is a link or device"),
        ("/scenes", entries(zeros=bytes(2_000_000)), ZIP, 400, "when extracted; at most"),
        ("/scenes?name=hall", b"", ZIP, 409, "a scene of this name exists"),
        ("/scenes?name=a/b", b"", ZIP, 400, "scene name 'a/b'"),
        ("/scenes?memory=lots", b"", ZIP, 400, "memory lots"),
        ("/scenes", b"{}", JSON, 400, 'body: give {"path": ...}'),
        ("/scenes", b'{"path": "a", "name": 3}', JSON, 400, "are strings"),
        ("/scenes", b"[" * 60_000, JSON, 400, "body: cannot be read"),
        ("/scenes", b" " * 70_000, JSON, 413, "body: more than"),
        ("/scenes", b'{"path": "a"}', JSON, 403, "started without --recordings"),
    ],
)
def test_refused_recordings_leave_nothing(
    serve: Any,
    hall_store: Path,
    path: str,
    body: bytes,
    headers: dict[str, str],
    status: int,
    message: str,
    small: Any,
) -> None:
    got = small.ask("POST", path, body=body, headers=headers)
    assert (got.status, list(got.json)) == (status, ["error"])
    assert message in got.json["error"]
    assert str(small.service.uploads) not in got.json["error"]
    assert list(small.service.uploads.iterdir()) == []


def test_an_archive_cannot_ask_for_files_elsewhere(serve: Any, copy: Path) -> None:
    pose = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    transforms = {
        "fl_x": 300, "fl_y": 300, "cx": 160, "cy": 120, "w": 320, "h": 240,
        "frames": [{"file_path": "/etc/hostname", "transform_matrix": pose}],
    }  # fmt: skip
    with serve(copy) as service:
        body = entries(**{"transforms.json": json.dumps(transforms).encode()})
        got = service.ask("POST", "/scenes", body=body, headers=ZIP)
        while (job := service.ask("GET", f"/jobs/{got.json['id']}").json)["status"] in (
            "queued",
            "learning",
        ):
            time.sleep(0.1)
        assert job["status"] == "failed"
        assert "transforms.json: image /etc/hostname lies outside the recording" in job["error"]


@pytest.fixture(scope="module")
def small(hall_store: Path) -> Any:
    from .conftest import running

    with running(hall_store, limits=Limits(unpacked_bytes=1_000_000)) as service:
        yield service


def test_a_killed_job_fails_and_the_next_one_runs(serve: Any, copy: Path, recording: Path) -> None:
    with serve(copy, limits=Limits(jobs=1)) as service:
        data, broken = archive(recording), entries(**{"notes.txt": b"no recording"})
        first = service.ask("POST", "/scenes?name=one", body=data, headers=ZIP).json["id"]
        until = time.monotonic() + 60
        while service.service.jobs._process is None:
            assert time.monotonic() < until
            time.sleep(0.01)
        second = service.ask("POST", "/scenes?name=two", body=broken, headers=ZIP)
        assert second.status == 202
        third = service.ask("POST", "/scenes?name=three", body=data, headers=ZIP)
        assert (third.status, third.json["error"]) == (429, "1 recordings wait; try again")
        os.kill(service.service.jobs._process.pid, signal.SIGKILL)
        job = service.job(first)
        assert (job["status"], job["error"]) == ("failed", "the process that learned it was ended")
        job = service.job(second.json["id"])
        assert job["status"] == "failed"
        assert job["error"].startswith("notes.txt: a file, not a folder, and no bag")
        assert service.ask("GET", "/scenes").json["scenes"] == ["hall"]


def test_a_service_without_a_map_learns_its_first_scene(
    serve: Any, tmp_path: Path, hall: Recording, recording: Path, image: Path
) -> None:
    with serve(tmp_path / "new") as service:
        assert service.ask("GET", "/scenes").json == {"scenes": []}
        got = service.ask("POST", "/localize", [("image", ("a.png", image.read_bytes()))])
        assert got.status == 400
        assert "no scene learned yet" in got.json["error"]
        got = service.ask("POST", "/scenes", body=archive(recording), headers=ZIP)
        service.service.jobs.close()  # as at the end of the service
        assert service.ask("GET", f"/jobs/{got.json['id']}").json["status"] in ("failed", "queued")
    assert not (tmp_path / "new").exists()
