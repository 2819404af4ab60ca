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
from evercal.geometry import SE3
from evercal.localization.estimate import PoseEstimate
from evercal.recordings import Recording, read_image
from evercal.recordings.samples import SampleRoom
from evercal.reports.demo_measurements import Look
from evercal.reports.demo_outcome import DemoOutcome, FixedCamera
from evercal.reports.demo_sentences import about_fixed_cameras
from evercal.simulation.box_room import box_room_scene


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [box_room_scene(seed, 24, 4) for seed in (41, 42)]
    still = replace(scenes[1].test[0], name="again")
    fixed = Recording("still", (), (scenes[1].test[0], still))
    changed = replace(scenes[1], name="later", train=())
    rooms = SampleRoom(scenes[0]), SampleRoom(scenes[1], fixed, fixed, changed)
    monkeypatch.setattr(demo, "DemoOptions", functools.partial(DemoOptions, rooms=rooms))


@pytest.mark.usefixtures("small")
def test_demo_leaves_a_report_a_picture_and_a_store(run: Any, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    outcome = json.loads(run("demo", "--out", out, "--json").out)
    assert outcome["rooms"] == ["box-room-41", "box-room-42"]
    assert [room["room"] for room in outcome["learned"]] == outcome["rooms"]
    assert all(room["landmarks"] > 0 for room in outcome["learned"])
    assert outcome["test"]["scenes"].keys() == set(outcome["rooms"])
    assert outcome["changed"]["scenes"].keys() == {"box-room-42"}
    assert outcome["memory_bytes"] > 0
    assert outcome["accuracy_5cm_5deg"] == {}
    (camera,) = outcome["fixed_cameras"]
    assert (camera["room"], camera["images"]) == ("box-room-42", 2)
    assert outcome["unknown_room"]["images"] == 20
    assert outcome["unknown_room"]["refused"] >= 15  # of rooms of the very same kind
    names = sorted(path.name for path in out.iterdir())
    assert names == ["overview.png", "query.png", "report.html", "store"]
    height, width, _ = read_image(out / "overview.png").shape
    assert width > 2 * height > 400
    page = (out / "report.html").read_text()
    assert page.count('<img src="data:image/') == 4  # overview, histogram, two sheets of images
    assert not re.search(r"(?:src|href)=\"(?!data:)", page)
    for heading in ("Test images", "After a change", "Calibration of a fixed camera"):
        assert heading in page
    assert "Fine-tuning" not in page
    assert run("localize", out / "store", out / "query.png").code in (0, 1)
    scenes = json.loads(run("info", out / "store", "--json").out)["scenes"]
    assert [scene["name"] for scene in scenes] == outcome["rooms"]


@pytest.mark.usefixtures("small")
def test_networks_are_compared_on_request(run: Any, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    ran = run("demo", "--out", out, "--compare")
    assert ran.code == 0
    assert "SARS + SPDD" in ran.out
    assert "wrote" in ran.out.splitlines()[-2]
    page = (out / "report.html").read_text()
    assert "Fine-tuning" in page
    assert "minutes" in page
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


def test_what_is_in_the_way_stays(run: Any, tmp_path: Path, snapshot: Any) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store/letter.txt").write_text("dear")
    before = snapshot(tmp_path)
    ran = run("demo", "--out", tmp_path)
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert snapshot(tmp_path) == before


def test_rows_leave_rooms_not_yet_learned_blank() -> None:
    outcome = DemoOutcome(["a", "b"], {"finetune": [[90.0], [0.0, 92.5]]}, {"finetune": 2.04})
    assert outcome.compared_rows() == [
        ["fine-tuning", "+ a", "90.0", "", ""],
        ["fine-tuning", "+ b", "0.0", "92.5", "2.0"],
    ]
    assert "92.5" in outcome.table()


class Answers:
    """A localizer of one room that has its answers from a list."""

    def __init__(self, room: str, answers: list[tuple[str, SE3 | None]]):
        self.answers = iter(answers)
        self.scenes, self.maps = [room, "elsewhere"], SimpleNamespace(keyframes=[None] * 2)

    def localize(self, image: object, camera: object) -> PoseEstimate:
        scene, pose = next(self.answers)
        if pose is None:
            return PoseEstimate("unknown_scene", "too dark", None, None, None, 0, 0.0, 0.0)
        return PoseEstimate("ok", "", scene, pose, np.eye(6) * 1e-8, 100, 0.5, 1.0)


def still_camera() -> tuple[SampleRoom, SE3]:
    """A room with a camera that takes five images before and five after a bump of 3 mm."""
    scene = box_room_scene(7, 1, 1)
    frame = scene.test[0]
    truth = frame.base_from_camera
    assert truth is not None
    moved = replace(frame, base_from_camera=truth @ SE3.exp([0.003, 0, 0, 0, 0, 0]))
    room = SampleRoom(
        scene, Recording("still", (), (frame,) * 5), None, Recording("bumped", (), (moved,) * 5)
    )
    return room, truth


def looked(room: SampleRoom, answers: list[tuple[str, SE3 | None]]) -> DemoOutcome:
    outcome = DemoOutcome([room.scene.name])
    localizer: Any = Answers(room.scene.name, answers)
    shown: list[int] = []
    Look(localizer, [room], lambda: shown.append(1)).find_fixed_cameras(outcome)
    assert len(shown) == 10  # the bar ends with the last image
    return outcome


def test_a_fixed_camera_is_calibrated_from_images_of_its_own_room() -> None:
    room, truth = still_camera()

    def off(metres: float) -> SE3:
        return truth @ SE3.exp([metres, 0, 0, 0, 0, 0])

    here = room.scene.name
    before = [
        (here, off(0.004)),
        (here, off(0.004)),
        ("elsewhere", off(3)),
        (here, off(0.004)),
        (here, None),
    ]
    nothing = [(here, None)] * 5
    outcome = looked(room, [*before, *nothing])
    (found,) = outcome.fixed
    assert (found.room, found.images, found.used) == (here, 5, 3)
    assert found.error_mm == pytest.approx(4.0, abs=1e-6)
    assert found.error_deg == pytest.approx(0.0, abs=1e-6)
    assert outcome.bumps == []  # nothing was found afterwards
    for lost in (nothing, [("elsewhere", off(3))] * 5):
        (none,) = looked(room, [*lost, *nothing]).fixed
        assert none == FixedCamera(here, 5, 0, None, None)
    shown = DemoOutcome([here], fixed=[found, none])
    assert shown.fixed_rows() == [[here, "3 of 5", "4.00", "0.000"], [here, "0 of 5", "", ""]]
    first, second = about_fixed_cameras(shown)
    assert "3 of 5 images: 4.00 mm" in first
    assert "not found in any of 5" in second


@pytest.mark.parametrize(("shift", "moved"), [(0.0035, True), (0.0005, False)])
def test_a_bump_is_what_check_says(shift: float, moved: bool) -> None:
    room, truth = still_camera()
    here = room.scene.name
    # Every other image is off by 0.2 mm, those after by the shift on top of it.
    before = [truth @ SE3.exp([0, 0.0002 * (i % 2), 0, 0, 0, 0]) for i in range(5)]
    after = [pose @ SE3.exp([shift, 0, 0, 0, 0, 0]) for pose in before]
    (bump,) = looked(room, [(here, pose) for pose in [*before, *after]]).bumps
    assert bump.shift_mm == pytest.approx(1000 * shift, abs=1e-6)
    assert (bump.true_mm, bump.true_deg) == pytest.approx((3.0, 0.0), abs=1e-6)
    assert 0.1 < bump.sigma_mm < 1.0
    assert bump.moved is moved
