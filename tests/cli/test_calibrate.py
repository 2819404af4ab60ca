"""`calibrate`, `check`, `watch` and `audit` as a user calls them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from evercal.mapping.scene_maps import SceneMaps

from evercal.calibration.calibration import read_calibration
from evercal.geometry import SE3, pose_distance
from evercal.mapping.store import Store
from evercal.recordings import write_image
from evercal.recordings.frame import Recording

Make = Callable[[Path, list[SceneMaps]], Store]


@pytest.fixture(scope="module")
def hall_store(make: Make, hall_maps: SceneMaps, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("calibrate") / "hall.evercal"
    make(root, [hall_maps])
    return root


@pytest.fixture(scope="module")
def images(hall: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four images of a camera that stands still."""
    folder, rng = tmp_path_factory.mktemp("images"), np.random.default_rng(0)
    still = hall.test[3].read_image().astype(float)
    for i in range(4):
        noisy = (still + rng.normal(0, 4, still.shape)).clip(0, 255).astype("u1")
        write_image(folder / f"{i}.png", noisy)
    return folder


def test_from_images_to_a_file_and_an_alarm(
    run: Callable, hall_store: Path, images: Path, hall: Recording, tmp_path: Path
) -> None:
    out = tmp_path / "calibration.json"
    done = run("calibrate", hall_store, images, "--out", out)
    assert done.code == 0, done.err
    assert "base_from_camera: the pose of camera in base" in done.out
    assert "4 of 4 used" in done.out
    found, truth = read_calibration(out), hall.test[3].base_from_camera
    assert truth is not None
    assert pose_distance(found.parent_from_child, truth)[0] < 0.004
    assert run("check", hall_store, images, "--reference", out).code == 0
    write_image(tmp_path / "moved.png", hall.test[6].read_image())
    moved = run("check", hall_store, tmp_path / "moved.png", "--reference", out, "--json")
    assert moved.code == 1
    assert json.loads(moved.out)["moved"] is True


def test_watch_stops_with_one_when_the_camera_moves(
    run: Callable, hall_store: Path, images: Path, hall: Recording, tmp_path: Path
) -> None:
    out, folder = tmp_path / "calibration.json", tmp_path / "arriving"
    assert run("calibrate", hall_store, images, "--out", out).code == 0
    folder.mkdir()
    words = ("watch", hall_store, folder, "--reference", out, "--interval", "0.05")
    for path in sorted(images.iterdir())[:3]:
        (folder / path.name).write_bytes(path.read_bytes())
    assert run(*words, "--idle", "0.5").code == 0
    for i in range(3):
        write_image(folder / f"later-{i}.png", hall.test[6].read_image())
    assert run(*words, "--idle", "5", "--window", "3").code == 1


def test_audit_lists_what_disagrees(
    run: Callable, hall_store: Path, hall: Recording, tmp_path: Path
) -> None:
    frame = hall.test[3]
    assert frame.base_from_camera is not None
    for name, shift in (("a", 0.0), ("b", 0.05)):
        (tmp_path / name).mkdir()
        write_image(tmp_path / name / "0.png", frame.read_image())
        stated = frame.base_from_camera @ SE3.exp([shift, 0, 0, 0, 0, 0])
        np.savetxt(tmp_path / name / "base_from_camera.txt", stated.matrix())
    done = run("audit", hall_store, tmp_path, "--json")
    assert done.code == 1
    verdicts = [episode["verdict"] for episode in json.loads(done.out)["episodes"]]
    assert verdicts == ["right", "wrong"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("calibrate", "STORE"), "no image given"),
        (("calibrate", "STORE", "none.png"), "none.png: image file is missing"),
        (("calibrate", "STORE", "EMPTY"), "no images in this folder"),
        (("calibrate", "STORE", "IMAGES", "--mount", "eye_in_hand"), "give --robot-poses"),
        (("calibrate", "STORE", "a=IMAGES", "IMAGES"), "do not go together"),
        (("calibrate", "STORE", "BLACK"), "none of 1 images was located"),
        (("check", "STORE", "IMAGES", "--reference", "none.json"), "calibration file is missing"),
        (("watch", "STORE", "none", "--reference", "none.json"), "no such folder"),
        (("audit", "STORE", "EMPTY"), "no folders in it"),
    ],
)
def test_bad_input_is_one_line(
    words: tuple[str, ...],
    said: str,
    run: Callable,
    hall_store: Path,
    images: Path,
    tmp_path: Path,
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "black").mkdir()
    write_image(tmp_path / "black" / "0.png", np.zeros((240, 320, 3), np.uint8))
    places = {"STORE": hall_store, "IMAGES": images}
    places |= {"EMPTY": tmp_path / "empty", "BLACK": tmp_path / "black"}
    given = [str(places.get(word, word)) for word in words]
    given = [word.replace("a=IMAGES", f"a={images}") for word in given]
    done = run(*given)
    assert done.code == 2
    assert said in " ".join(done.err)
