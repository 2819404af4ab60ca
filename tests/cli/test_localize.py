"""`evercal localize`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3, UncertainPose, pose_distance
from evercal.localization.estimate import PoseEstimate
from evercal.recordings import read_image, write_image

KEYS = "path status reason scene base_from_camera covariance inliers inlier_ratio support ms"
KEYS += " error_terms unit alternatives alternatives_in parent_frame base"
CAUSES = ["view", "lens", "map", "stated poses", "base frame"]


@pytest.fixture
def images(hall, tmp_path) -> Path:
    """A folder of an image of the hall and a black one."""
    folder = tmp_path / "images"
    folder.mkdir()
    write_image(folder / "1-hall.png", hall.test[7].read_image())
    write_image(folder / "2-black.png", np.zeros((240, 320, 3), np.uint8))
    return folder


def test_json_of_a_folder(run, hall_store, images, hall):
    ran = run("localize", hall_store, images, "--json")
    assert ran.code == 0  # one image has a pose
    assert ran.json.keys() == {"images"}
    located, unknown = ran.json["images"]
    assert located.keys() == unknown.keys() == set(KEYS.split())
    paths = [str(path) for path in sorted(images.iterdir())]
    assert [located["path"], unknown["path"]] == paths
    outcome = [located[key] for key in ("status", "reason", "scene", "unit")]
    assert outcome == ["ok", "", "hall", "metres"]
    pose = located["base_from_camera"]
    truth = hall.test[7].base_from_camera
    assert pose.keys() == {"translation_m", "quaternion_wxyz", "matrix"}
    estimate = SE3(np.array(pose["quaternion_wxyz"]), np.array(pose["translation_m"]))
    np.testing.assert_allclose(pose["matrix"], estimate.matrix(), atol=1e-12)
    assert pose_distance(estimate, truth)[0] < 0.005
    assert np.shape(located["covariance"]) == (6, 6)
    assert located["inliers"] > 20
    terms = located["error_terms"]
    assert [term["name"] for term in terms] == CAUSES
    assert sum(term["share"] for term in terms) == pytest.approx(1)
    mean = 1e6 * np.diag(located["covariance"])[:3].mean()
    assert sum(term["translation_mm"] ** 2 for term in terms) == pytest.approx(mean)
    assert unknown["status"] in ("unknown_scene", "failed")
    assert unknown["reason"]
    assert (
        unknown["base_from_camera"] is unknown["covariance"] is unknown["unit"] is None
    )
    assert unknown["error_terms"] == []
    assert min(located["ms"], unknown["ms"]) > 0


def test_text_has_millimetres_and_the_next_command(run, hall_store, images):
    files = sorted(images.iterdir())
    [located, _] = run.json("localize", hall_store, images)["images"]
    lines = run("localize", hall_store, images).out.splitlines()
    assert lines[0] == str(files[0])
    assert lines[1].split() == ["scene", "hall"]
    sd = 1000 * np.sqrt(np.diagonal(located["covariance"])[:3])
    assert lines[2].endswith(f" m  sd {sd[0]:.2f} {sd[1]:.2f} {sd[2]:.2f} mm")
    assert lines[3].endswith(" deg")
    assert lines[4].endswith(" of the position's variance")
    assert lines[6] == str(files[1])
    assert lines[-1] == f"next: evercal localize {hall_store} {files[0]} --overlay DIR"


def test_several_images_end_with_one_line_about_all(run, hall_store, images):
    located, unknown = run.json("localize", hall_store, images)["images"]
    mean = np.diagonal(located["covariance"])[:3].mean()
    sd = f"standard deviation {1000 * np.sqrt(mean):.2f} mm per axis (median)"
    words = unknown["status"].replace("_", " ")
    lines = run("localize", hall_store, images).out.splitlines()
    assert lines[-2] == f"1 of 2 images located, in hall 1; refused: {words} 1; {sd}"
    (black,) = sorted(images.iterdir())[1:]
    assert "located" not in run("localize", hall_store, black).out


def test_a_refused_image_of_a_known_scene_names_it(
    run, hall_store, images, monkeypatch
):
    from evercal.localization.localizer import Localizer

    def localize(*_: object) -> PoseEstimate:
        failed = PoseEstimate.failed("its position is uncertain")
        return replace(failed, status="uncertain", scene="hall")

    monkeypatch.setattr(Localizer, "localize", localize)
    lines = run("localize", hall_store, images / "1-hall.png").out.splitlines()
    assert lines[1].split() == ["scene", "hall"]
    assert lines[2] == "  uncertain: its position is uncertain"


def test_point_in_the_camera_frame_has_a_standard_deviation(run, hall_store, images):
    point = [-0.2, 0.1, 1.5]
    words = ("localize", hall_store, images, "--at -0.2,0.1,1.5")
    located, unknown = run.json(*words)["images"]
    pose = SE3.from_matrix(np.array(located["base_from_camera"]["matrix"]))
    sigma = UncertainPose(pose, np.array(located["covariance"])).point_sigma_mm(point)
    at = located["at"]
    assert at["point_m"] == point
    np.testing.assert_allclose(at["in_parent_m"], pose.apply(np.array(point)))
    assert at["sigma_mm"] == pytest.approx(sigma)
    assert unknown["at"] is None
    text = run(*words).out
    assert f"sd {sigma:.2f} mm at (-0.2, 0.1, 1.5) m in the camera frame" in text


def test_exit_code_is_1_without_any_pose(run, hall_store, images):
    ran = run("localize", hall_store, images / "2-black.png")
    assert ran.code == 1
    assert ran.out.splitlines()[-1] == f"next: evercal learn {hall_store} RECORDING"


def test_overlays_have_the_size_of_their_images(
    run, hall_store, images, hall, tmp_path
):
    twin = tmp_path / "other" / "1-Hall.png"
    out = tmp_path / "overlays"
    twin.parent.mkdir()
    write_image(twin, np.repeat(np.repeat(hall.test[8].read_image(), 2, 0), 2, 1))
    assert run("localize", hall_store, twin, images, "--overlay", out).code == 0
    drawn = {path.name: read_image(path) for path in out.iterdir()}
    # Images without a scene get no overlay; images of one name are numbered.
    assert drawn.keys() == {"1-1-Hall-overlay.png", "2-1-hall-overlay.png"}
    assert drawn["1-1-Hall-overlay.png"].shape == (480, 640, 3)
    assert (drawn["2-1-hall-overlay.png"] != hall.test[7].read_image()).any()


def test_camera_file_replaces_the_camera_of_the_scene(
    run, hall_store, images, hall, tmp_path
):
    camera = hall.test[7].camera
    image = images / "1-hall.png"
    (tmp_path / "camera.json").write_text(json.dumps(camera.to_dict()))
    matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    longer = np.multiply(matrix, [[1.2, 1, 1], [1, 1.2, 1], [1, 1, 1]])
    np.savetxt(tmp_path / "longer.txt", longer)

    def pose(*options: object) -> object:
        ran = run("localize", hall_store, image, "--json", *options)
        return ran.json["images"][0]["base_from_camera"]

    stated = pose("--camera", tmp_path / "camera.json")
    assert stated is not None
    assert stated != pose("--camera", tmp_path / "longer.txt")


def test_video_holds_every_image_and_json_only_its_object(
    run, hall_store, images, tmp_path
):
    ran = run("localize", hall_store, images, "--video", tmp_path / "a.mp4", "--json")
    rows = ran.json["images"]
    assert (ran.code, ran.err) == (0, [])
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    frames = [image for ok, image in (video.read() for _ in range(9)) if ok]
    assert len(frames) == len(rows)
    assert frames[0].shape == (560, 1280, 3)


@pytest.mark.slow(
    "src/evercal/features", "src/evercal/localization", "src/evercal/cli/__init__.py"
)
def test_float32_gives_the_same_bytes_with_other_instructions(
    hall_store, hall, tmp_path
):
    """Libraries choose kernels by the processor; older ones are emulated by their switches."""
    write_image(tmp_path / "image.png", np.asarray(hall.test[7].read_image()))
    older = {
        "ATEN_CPU_CAPABILITY": "avx2",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2",
        "OPENCV_CPU_DISABLE": "AVX512_SKX",
    }
    command = [sys.executable, "-m", "evercal", "localize", str(hall_store)]
    rows = []
    for instructions in ({}, older):
        set_to = {**os.environ, "EVERCAL_PRECISION": "float32", **instructions}
        done = subprocess.run(
            [*command, str(tmp_path / "image.png"), "--json"],
            env=set_to,
            capture_output=True,
            text=True,
            check=True,
        )
        (row,) = json.loads(done.stdout)["images"]
        del row["ms"]
        rows.append(row)
    assert rows[0]["status"] == "ok"
    assert rows[0] == rows[1]


def test_an_unreadable_image_has_a_row(run, hall_store, images):
    (images / "0-cut.png").write_bytes((images / "1-hall.png").read_bytes()[:-200])
    (images / "._1-hall.png").write_bytes(b"hidden")
    ran = run("localize", hall_store, images, "--json")
    cut, located, _ = ran.json["images"]
    assert (ran.code, cut["status"], located["status"]) == (0, "failed", "ok")
    assert "0-cut.png: not a readable image" in cut["reason"]
