"""`evercal demo`, made small."""

import functools
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evercal.cli import demo
from evercal.cli.demo import DemoOptions
from evercal.datasets import Frame, Scene, read_image
from evercal.geometry import SE3
from evercal.reports import demo_page
from evercal.reports.demo_outcome import DemoOutcome, FixedCamera
from evercal.simulation import mini
from evercal.simulation.box_room import box_room_scene
from evercal.simulation.mini import CellRoom


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [box_room_scene(seed, 16, 4) for seed in (41, 42)]
    still = replace(scenes[1].test[0], name="again")
    fixed = Scene("still", (), (scenes[1].test[0], still))
    rooms = CellRoom(scenes[0]), CellRoom(scenes[1], fixed)
    monkeypatch.setattr(demo, "DemoOptions", functools.partial(DemoOptions, rooms=rooms))


@pytest.mark.usefixtures("small")
def test_demo_leaves_a_report_a_picture_and_a_store(run: Any, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    outcome = json.loads(run("demo", "--out", out, "--json").out)
    assert outcome["rooms"] == ["box-room-41", "box-room-42"]
    for method in ("evercal", "finetune"):
        first, second = outcome["accuracy_5cm_5deg"][method]
        assert (len(first), len(second)) == (1, 2)
        assert all(0 <= value <= 100 for value in first + second)
    assert outcome["memory_bytes"] > 0
    (camera,) = outcome["fixed_cameras"]
    assert (camera["room"], camera["images"]) == ("box-room-42", 2)
    names = sorted(path.name for path in out.iterdir())
    assert names == ["overview.png", "query.png", "report.html", "store"]
    height, width, _ = read_image(out / "overview.png").shape
    assert width > 2 * height > 400
    page = (out / "report.html").read_text()
    assert page.count('<img src="data:image/') == 3
    assert not re.search(r"(?:src|href)=\"(?!data:)", page)
    assert "fine-tuning" in page
    assert "Calibration of a fixed camera" in page
    assert run("localize", out / "store", out / "query.png").code in (0, 1)
    scenes = json.loads(run("info", out / "store", "--json").out)["scenes"]
    assert [scene["name"] for scene in scenes] == outcome["rooms"]


def test_bare_shapes_lie_over_located_images(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = box_room_scene(7, 1, 6)
    asked: list[tuple[object, list[Frame], list[SE3]]] = []

    def clay(model: object, frames: list[Frame], poses: list[SE3]) -> list[np.ndarray]:
        asked.append((model, frames, poses))
        return [np.full_like(frame.read_image(), 250) for frame in frames]

    monkeypatch.setattr(mini, "untextured_renders", clay)
    pose = SE3.identity()
    answers = [(scene.name, pose), ("elsewhere", pose), (scene.name, None)]
    room = CellRoom(scene, model=("living", 3))
    overlays = demo_page._overlays(Answers(answers), scene)  # pyright: ignore[reportArgumentType]
    (drawn,) = demo_page._untextured_overlays(room, overlays)
    ((model, frames, poses),) = asked
    assert (model, frames, poses) == (("living", 3), [scene.test[1]], [pose])
    expected = (frames[0].read_image().astype(int) + 250) // 2
    np.testing.assert_array_equal(drawn, expected)
    assert demo_page._untextured_overlays(CellRoom(scene), overlays) == []


@pytest.mark.usefixtures("small")
def test_what_is_in_the_way_stays(run: Any, tmp_path: Path, snapshot: Any) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store/letter.txt").write_text("dear")
    before = snapshot(tmp_path)
    ran = run("demo", "--out", tmp_path)
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert snapshot(tmp_path) == before


def test_rows_leave_rooms_not_yet_learned_blank() -> None:
    outcome = DemoOutcome(["a", "b"], {"finetune": [[90.0], [0.0, 92.5]]})
    assert outcome.rows() == [
        ["fine-tuning", "+ a", "90.0", ""],
        ["fine-tuning", "+ b", "0.0", "92.5"],
    ]
    assert "92.5" in outcome.table()


class Answers:
    """A localizer that has its answers from a list."""

    def __init__(self, answers: list[tuple[str, SE3 | None]]):
        self.answers = iter(answers)

    def localize(self, image: object, camera: object) -> SimpleNamespace:
        scene, pose = next(self.answers)
        return SimpleNamespace(scene=scene, base_from_camera=pose, inliers=9, points_m=None)


def test_a_fixed_camera_is_the_robust_mean_of_its_own_room() -> None:
    scene = box_room_scene(7, 1, 1)
    frame = scene.test[0]
    truth = frame.base_from_camera
    assert truth is not None
    room = CellRoom(scene, Scene("still", (), (frame,) * 5))

    def off(metres: float) -> SE3:
        return truth @ SE3.exp([metres, 0, 0, 0, 0, 0])

    here = scene.name
    far = [
        (here, off(0.004)),
        (here, off(0.004)),
        ("elsewhere", off(3)),
        (here, off(9)),
        (here, None),
    ]
    found = demo._find_fixed(Answers(far), room)  # pyright: ignore[reportArgumentType]
    assert (found.room, found.images, found.located) == (here, 5, 3)
    assert found.error_mm == pytest.approx(4.0, abs=1e-6)
    assert found.error_deg == pytest.approx(0.0, abs=1e-6)
    none = demo._find_fixed(Answers([(here, None)] * 5), room)  # pyright: ignore[reportArgumentType]
    assert none == FixedCamera(here, 5, 0, None, None)
    shown = DemoOutcome([here], fixed=[found, none])
    assert shown.fixed_rows() == [[here, "3 of 5", "4.0", "0.00"], [here, "0 of 5", "", ""]]
