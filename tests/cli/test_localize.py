"""`evercal localize`: the JSON that other programs read, exit codes, pictures, refusals."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.recordings import load_recording, read_image, write_image

KEYS = {"path", "status", "reason", "scene", "base_from_camera", "covariance", "inliers"}
KEYS |= {"inlier_ratio", "ms"}
POSE = SE3.exp(np.array([0.3, -0.2, 1.0, 0.4, -0.5, 0.2]))
NO = PoseEstimate("unknown_scene", "3 % of the cells agree", None, None, None, 36, 0.03, 1.0)


def answer(points_camera: np.ndarray) -> PoseEstimate:
    sd = np.array([0.01, 0.02, 0.03, *np.deg2rad([0.1, 0.2, 0.3])])
    points = POSE.apply(points_camera)
    pixels = np.zeros((len(points), 2))
    return PoseEstimate(
        "ok", "", "box-room-41", POSE, np.diag(sd**2), len(points), 0.5, 1.0, pixels, points
    )


@pytest.fixture
def images(rooms: Any) -> list[Path]:
    found = [frame.image for frame in load_recording(rooms[0]).test[:2]]
    return [path for path in found if isinstance(path, Path)]


@pytest.fixture
def says(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes the localizer give these answers in turn; returns the cameras it was asked with."""

    def prepare(*answers: PoseEstimate) -> list[Camera | None]:
        asked: list[Camera | None] = []

        def localize(self: Localizer, image: np.ndarray, camera: Camera | None = None) -> Any:
            asked.append(camera)
            return answers[len(asked) - 1]

        monkeypatch.setattr(Localizer, "localize", localize)
        return asked

    return prepare


def test_json_is_the_contract(run: Any, store: Path, images: list[Path], says: Any) -> None:
    says(answer(np.array([[0.0, 0.0, 2.0]])), NO)
    ran = run("localize", store, *images, "--json")
    assert ran.code == 0  # one image has a pose
    assert json.loads(ran.out).keys() == {"images"}
    found, lost = json.loads(ran.out)["images"]
    assert found.keys() == lost.keys() == KEYS
    assert [found["path"], lost["path"]] == [str(path) for path in images]
    pose = found["base_from_camera"]
    assert pose.keys() == {"translation_m", "quaternion_wxyz", "matrix"}
    np.testing.assert_allclose(pose["matrix"], POSE.matrix(), atol=1e-12)
    again = SE3(np.array(pose["quaternion_wxyz"]), np.array(pose["translation_m"]))
    np.testing.assert_allclose(again.matrix(), POSE.matrix(), atol=1e-12)
    assert np.shape(found["covariance"]) == (6, 6)
    assert (found["status"], found["scene"], found["inliers"]) == ("ok", "box-room-41", 1)
    assert lost["base_from_camera"] is lost["covariance"] is lost["scene"] is None
    assert (lost["status"], lost["reason"]) == ("unknown_scene", NO.reason)
    assert min(found["ms"], lost["ms"]) > 0


def test_text_says_where_and_how_sure(run: Any, store: Path, images: list[Path], says: Any) -> None:
    says(answer(np.array([[0.0, 0.0, 2.0]])), NO)
    lines = run("localize", store, *images).out.splitlines()
    assert lines[0] == str(images[0])
    assert lines[1].split() == ["scene", "box-room-41"]
    assert lines[2].endswith(" m  sd 1.00 2.00 3.00 cm")
    assert lines[3].endswith(" wxyz  sd 0.10 0.20 0.30 deg")
    assert lines[6] == "  unknown scene: 3 % of the cells agree"
    assert lines[-1].startswith("next: evercal localize ")


def test_exit_code_is_1_only_without_any_pose(
    run: Any, store: Path, images: list[Path], says: Any
) -> None:
    says(NO, NO)
    ran = run("localize", store, *images, "--json")
    assert ran.code == 1
    assert [image["status"] for image in json.loads(ran.out)["images"]] == ["unknown_scene"] * 2


def test_the_real_thing_gives_the_same_answer_twice(
    run: Any, store: Path, images: list[Path]
) -> None:
    first, second = (
        json.loads(run("localize", store, *images, "--json").out)["images"] for _ in range(2)
    )
    for image in (*first, *second):
        assert image.pop("ms") > 0
        assert image.keys() == KEYS - {"ms"}
    assert first == second


def test_overlay_draws_scene_points_where_the_camera_sees_them(
    run: Any, store: Path, images: list[Path], says: Any, tmp_path: Path
) -> None:
    twin = tmp_path / "other" / images[0].name
    twin.parent.mkdir()
    write_image(twin, np.full((480, 640, 3), 255, np.uint8))  # larger than what was learned from
    says(
        answer(np.array([[0.5, -0.25, 2.0], [0.0, 0.0, 1.0]])), NO, answer(np.array([[-0.2, 0, 1]]))
    )
    assert run("localize", store, twin, images[1], images[0], "--overlay", tmp_path / "o").code == 0
    stem = images[0].stem
    names = sorted(path.name for path in (tmp_path / "o").iterdir())
    assert names == [f"{stem}-1-overlay.png", f"{stem}-3-overlay.png"]  # none without a pose
    drawn = read_image(tmp_path / "o" / names[0])
    assert drawn.shape == (480, 640, 3)
    lens = load_recording(Path(images[0]).parents[1]).train[0].camera.resized(640, 480)
    for x, y in lens.project(np.array([[0.5, -0.25, 2.0], [0.0, 0.0, 1.0]])).round().astype(int):
        assert np.ptp(drawn[y, x].astype(int)) > 30  # coloured on a grey picture
    assert (drawn[40:60, 40:60] == 255).all()


def test_camera_files_reach_the_localizer(
    run: Any, store: Path, images: list[Path], says: Any, tmp_path: Path
) -> None:
    asked = says(NO, NO)
    np.savetxt(tmp_path / "k.txt", [[300, 0, 150], [0, 310, 110], [0, 0, 1]])
    run("localize", store, images[0], "--camera", tmp_path / "k.txt")
    assert asked == [Camera(320, 240, 300, 310, 150, 110)]
    lens = Camera(640, 480, 500, 500, 320, 240, (0.1, 0.0, 0.0, 0.0))
    (tmp_path / "lens.json").write_text(json.dumps(lens.to_dict()))
    run("localize", store, images[0], "--camera", tmp_path / "lens.json")
    assert asked[1] == lens


@pytest.mark.parametrize(
    "kind",
    ["missing", "unreadable", "folder", "portrait", "none", "camera", "misfit", "overlay", "store"],
)
@pytest.mark.parametrize("as_json", [False, True])
def test_bad_input_is_one_line_before_anything_else(
    run: Any,
    store: Path,
    images: list[Path],
    snapshot: Any,
    tmp_path: Path,
    kind: str,
    as_json: bool,
) -> None:
    (tmp_path / "broken.png").write_bytes(b"\x89PNG broken")
    write_image(tmp_path / "portrait.png", np.zeros((320, 240, 3), np.uint8))
    tall = Camera(240, 320, 250, 250, 119.5, 159.5)
    (tmp_path / "tall.json").write_text(json.dumps(tall.to_dict()))
    words: list[object] = {
        "missing": [store, images[0], tmp_path / "nowhere.png"],
        "unreadable": [store, images[0], tmp_path / "broken.png"],
        "folder": [store, images[0], tmp_path],
        "portrait": [store, images[0], tmp_path / "portrait.png"],
        "none": [store],
        "camera": [store, images[0], "--camera", tmp_path / "broken.png"],
        "misfit": [store, images[0], "--camera", tmp_path / "tall.json"],
        "overlay": [store, images[0], "--overlay", tmp_path / "broken.png"],
        "store": [tmp_path, images[0]],
    }[kind]
    before = snapshot(store)
    ran = run("localize", *words, *(["--json"] if as_json else []))
    assert ran.code == 2
    assert len(ran.err) == 1
    assert ran.err[0].startswith("error: ")
    assert snapshot(store) == before
    if as_json:
        assert json.loads(ran.out) == {"error": ran.err[0].removeprefix("error: ")}
    else:
        assert ran.out == ""


def test_a_device_that_is_not_there_is_refused_in_one_line(
    run: Any, store: Path, images: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    refused = run("localize", store, images[0], "--device", "cuda")
    assert refused.code == 2
    assert len(refused.err) == 1
    assert refused.err[0].startswith("error: device 'cuda': ")
