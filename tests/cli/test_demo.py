"""`evercal demo` on small rooms."""

import json
import re
from dataclasses import replace

import pytest

from evercal.cli import demo
from evercal.cli.demo import run_demo
from evercal.evaluation import FrameResult
from evercal.geometry import SE3
from evercal.recordings import Recording
from evercal.recordings.samples import SampleRoom
from evercal.reports.demo_page import DemoResult, FixedCamera

from ..box_world import box_room_scene


def small_room(seed: int) -> SampleRoom:
    """A room whose fixed camera took three equal images before and after a bump of 3 mm."""
    scene = box_room_scene(seed, 24, 4)
    frame = scene.test[0]
    assert frame.base_from_camera is not None
    moved = frame.base_from_camera @ SE3.exp([0.003, 0, 0, 0, 0, 0])
    frames = [replace(frame, name=f"{i}") for i in range(3)]
    bumped = [replace(frame, base_from_camera=moved) for frame in frames]
    return SampleRoom(
        scene,
        Recording("fixed", (), tuple(frames)),
        Recording("bumped", (), tuple(bumped)),
        replace(scene, train=()),
    )


@pytest.fixture(scope="module")
def rooms() -> list[SampleRoom]:
    return [small_room(41), small_room(42)]


def test_demo_writes_report_store_and_query(run, tmp_path, rooms):
    result = run_demo(tmp_path, rooms)
    record = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    names = ["box-room-41", "box-room-42"]
    assert record["rooms"] == names
    assert all(room["landmarks"] > 0 for room in record["learned"])
    assert list(record["test"]["scenes"]) == list(record["changed"]["scenes"]) == names
    assert record["memory_bytes"] > 0
    for camera in record["fixed_cameras"]:
        assert camera["images"] == 3
        assert camera["true_shift_mm"] == pytest.approx(3.0, abs=1e-6)
        assert not camera["bump_detected"]  # the images are equal
        if camera["images_used"]:
            assert camera["error_mm"] < 100
            assert camera["shift_mm"] == pytest.approx(0.0, abs=1e-6)
    unknown = record["unknown_room"]
    assert unknown["images"] == 4  # the second room before it is learned
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "query.png",
        "report.html",
        "store",
    ]
    page = (tmp_path / "report.html").read_text()
    assert page.count('src="data:image/') == 2 * demo.PICTURES
    assert not re.search(r"(?:src|href)=\"(?!data:)", page)
    assert page.index("<h1>") < page.index('class="tiles"') < page.index("<h2>")
    assert run("localize", tmp_path / "store", tmp_path / "query.png").code in (0, 1)
    scenes = run.json("info", tmp_path / "store")["scenes"]
    assert [scene["name"] for scene in scenes] == names


def test_other_data_in_the_output_folder_are_refused(run, tmp_path, snapshot):
    (tmp_path / "store").mkdir()
    (tmp_path / "store/letter.txt").write_text("dear")
    before = snapshot(tmp_path)
    assert "pass another --out" in run.refused("demo --out", tmp_path)
    assert snapshot(tmp_path) == before


def test_copied_samples_are_recordings_and_nothing_else(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = run("demo --copy-samples samples")
    assert (ran.code, ran.err) == (0, [])
    assert [path.name for path in tmp_path.iterdir()] == ["samples"]
    names = sorted(path.name for path in (tmp_path / "samples").iterdir())
    assert names == ["bedroom", "cell", "kitchen", "living"]
    assert ran.out.splitlines()[-1] == (
        "next: evercal learn cell.evercal samples/cell/wrist --calibration wrist.json"
    )
    for folder in ("kitchen", "cell/wrist"):
        assert run("inspect", f"samples/{folder}").code == 0
    again = run("demo --copy-samples samples --json")
    assert again.code == 2
    assert "samples: is not empty" in again.json["error"]


def test_headlines_are_medians():
    test = [
        FrameResult("a", str(i), mm / 1000, 0.001, "ok", "a", False, 1.0, 9, 0.5)
        for i, mm in enumerate([1.0, 3.0, 50.0])
    ]
    cameras = [
        FixedCamera("a", 5, 5, 0.8, 0.02, 0.5, 5.1, 5.0, True),
        FixedCamera("b", 5, true_shift_mm=5.0),
    ]
    result = DemoResult(
        test=test, cameras=cameras, unknown_images=12, unknown_refused=11
    )
    assert result.headlines() == {
        "3.00 mm": "median position error of one image, 0.057 deg in rotation",
        "0.80 mm": "median position error of a fixed camera after calibration",
        "1 of 2 bumps": "detected: 5.10 mm measured, 5.00 mm true (medians)",
        "11 of 12": "images of unknown rooms refused",
    }
