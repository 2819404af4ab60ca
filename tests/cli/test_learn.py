"""`evercal learn`."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from evercal import Map
from evercal.calibration.calibration import read_calibration
from evercal.mapping.store import MapStore
from evercal.recordings.samples import CELL

KEYS = "scene seconds iterations memory_bytes head_bytes frames_kept landmarks train_frames"
KEYS += " held_out_frames adjusted hand_eye fixed_share warnings same_place set_aside"
ADJUSTED = "common_translation_mm common_rotation_deg focal_percent residual_px"


@pytest.fixture(scope="module")
def wrist(tmp_path_factory) -> Path:
    """A recording with gripper poses; its stated focal length is 1 % too long."""
    folder = tmp_path_factory.mktemp("wrist") / "wrist"
    shutil.copytree(CELL / "wrist", folder)
    camera = json.loads((folder / "camera.json").read_text())
    camera |= {"fx": 1.01 * camera["fx"], "fy": 1.01 * camera["fy"]}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def test_two_scenes_are_learned_and_reported(run, learned, rooms, tmp_path):
    store, text = learned
    first, second, *_, last = text.splitlines()
    assert first == "box-room-41: 24 training frames"
    assert second.startswith("mapped box-room-41: 20 images, ")
    assert text.count("\n  set aside    ") == 4
    assert " deg from its stated pose" in text
    assert "move the corners" not in text
    assert last == f"next: evercal evaluate {store} {rooms[0]}"
    copy = shutil.copytree(store, tmp_path / "copy")
    ran = run("learn", copy, rooms[1], "--name cell --memory 60kB --json")
    report = ran.json
    assert report.keys() == set(KEYS.split())
    assert report["adjusted"].keys() >= set(ADJUSTED.split())
    assert report["scene"] == "cell"
    assert report["landmarks"] > 50
    errors = report["set_aside"].values()
    assert len(errors) == report["held_out_frames"] == 4
    assert {*map(len, errors)} <= {0, 2}  # few keyframes are far from the block
    assert report["iterations"] == report["head_bytes"] == 0
    assert report["hand_eye"] is None
    assert len(ran.err) == 1  # the line about frames; the rest is progress
    default, cell = run.json("info", copy)["scenes"]
    assert (default["name"], cell["name"]) == ("box-room-41", "cell")
    assert default["keyframes"] == 8  # at least; 10 % of the frames are two
    assert 0 < cell["memory_bytes"] <= 60_000


def test_calibration_has_the_estimated_transform_and_the_adjusted_camera(
    run, wrist, tmp_path
):
    out = tmp_path / "wrist.json"
    ran = run("learn", tmp_path / "s", wrist, "--every", 2, "--calibration", out)
    assert ran.code == 0, ran.err
    assert "gripper_from_camera: (" in ran.out
    assert "set aside" not in ran.out
    assert "  left out     half of the poses are predicted within " in ran.out
    assert ran.out.splitlines()[-2] == f"wrote {out}"
    calibration = read_calibration(out)
    truth = json.loads((CELL / "truth.json").read_text())["gripper_from_camera"]
    assert calibration.mount == "eye_in_hand"
    np.testing.assert_allclose(
        calibration.parent_from_child.translation_m, truth["translation_m"], atol=0.005
    )
    [scene] = MapStore.open(tmp_path / "s").contents.scenes
    assert calibration.camera == scene.adjusted_camera
    assert scene.adjusted_camera.fx / scene.camera.fx == pytest.approx(
        1 / 1.01, abs=0.005
    )


def test_intrinsics_that_the_images_contradict_are_shown(run, rooms, tmp_path):
    room = shutil.copytree(rooms[0], tmp_path / "room")
    scene = json.loads((room / "scene.json").read_text())
    for camera in scene["cameras"].values():
        camera |= {"fx": 1.06 * camera["fx"], "fy": 1.06 * camera["fy"]}
    (room / "scene.json").write_text(json.dumps(scene))
    ran = run("learn", tmp_path / "s", room, "--name cell")
    assert ran.code == 0, ran.err
    assert ran.out.endswith(f"next: evercal evaluate {tmp_path / 's'} cell={room}\n")
    [line] = [line for line in ran.out.splitlines() if "move the corners" in line]
    found = re.search(r"by (\S+) px: .* stated as (.*), adjusted (.*); check", line)
    assert found is not None
    stated, adjusted = (float(part.split()[0]) for part in found.groups()[1:])
    assert adjusted / stated == pytest.approx(1 / 1.06, abs=0.01)
    assert float(found[1]) > 3


def test_interrupt_leaves_no_map(rooms, tmp_path):
    store = tmp_path / "s"
    words = [sys.executable, "-m", "evercal", "learn", store, rooms[0]]

    def interruptible() -> None:  # a shell's background jobs ignore SIGINT
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    pipe = subprocess.PIPE
    with subprocess.Popen(
        words, stdout=pipe, stderr=pipe, text=True, preexec_fn=interruptible
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline().startswith("box-room-41: 24 training frames")
        # A signal inside a destructor is lost; a second one while Python ends kills the process.
        for _ in range(5):
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=20)
                break
        assert process.returncode == 130
        messages = process.stderr.read()
    assert "stopped; run the same command again" in messages
    assert "Traceback" not in messages
    assert not (store / "manifest.json").exists()


def damaged(kind: str, room: Path, folder: Path) -> Path:
    """A recording with one mistake."""
    shutil.copytree(room, folder)
    data = json.loads((folder / "scene.json").read_text())
    if kind == "missing images":
        for file in sorted((folder / "images").iterdir())[1:]:
            file.unlink()
    elif kind == "few frames":
        data["frames"] = data["frames"][:5]
    elif kind == "no poses":
        data["frames"] = [
            frame | {"base_from_camera": None} for frame in data["frames"]
        ]
    elif kind == "escape":
        data["name"] = "../../escape"
    (folder / "scene.json").write_text(
        "{" if kind == "broken json" else json.dumps(data)
    )
    return folder


@pytest.mark.parametrize(
    "kind", ["missing images", "broken json", "few frames", "no poses", "escape"]
)
def test_bad_recordings_are_one_line_and_leave_the_store(
    run, store, rooms, snapshot, tmp_path, kind
):
    scene = damaged(kind, rooms[1], tmp_path / "scene")
    for folder in (store, tmp_path / "new"):
        before = snapshot(folder)
        run.refused("learn", folder, scene)
        assert snapshot(folder) == before
    assert not folder.exists()


def test_a_broken_image_is_left_out_and_named(run, store, rooms, tmp_path):
    copy = Path(shutil.copytree(store, tmp_path / "store"))
    shutil.copytree(rooms[1], tmp_path / "scene")
    (tmp_path / "scene/images/000003.png").write_bytes(b"no image")
    ran = run("learn", copy, tmp_path / "scene")
    assert ran.code == 0, ran.err
    assert "1 of 30 images are missing or unreadable and left out" in ran.err[0]
    assert "000003.png" in ran.err[0]
    assert Map.open(copy).scenes[:-1] == Map.open(store).scenes


def test_other_folders_are_not_overwritten(run, rooms, snapshot, tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home/letter.txt").write_text("dear")
    run.refused("learn", tmp_path / "home", rooms[0])
    assert snapshot(tmp_path / "home") == {"letter.txt": b"dear"}
    (tmp_path / "file").write_text("x")
    assert run("learn", tmp_path / "file", rooms[0]).code == 2
