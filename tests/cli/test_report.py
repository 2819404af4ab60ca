"""`evercal report`: the HTML file, the JSON object and the error messages."""

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from evercal.calibration.calibration import Calibration, ImageUse
from evercal.geometry import SE3, Camera
from evercal.recordings.images import write_image


def pose(quaternion: ArrayLike, translation: ArrayLike) -> SE3:
    return SE3(np.array(quaternion, np.float64), np.array(translation, np.float64))


CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
POSE = pose([0.0, 1.0, 0.0, 0.0], [0.1, 0.05, 1.0])


@pytest.fixture
def calibration(tmp_path) -> Path:
    write_image(tmp_path / "a.png", np.full((48, 64, 3), 90, np.uint8))
    images = (
        ImageUse("a.png", True, "", 0.5, 0.01),
        ImageUse("b.png", False, "too dark"),
    )
    own = Calibration(
        "eye_to_hand", POSE, 1e-8 * np.eye(6), camera=CAMERA, images=images
    )
    own.write(tmp_path / "c.json")
    return tmp_path / "c.json"


def test_report_is_one_self_contained_file(run, calibration, tmp_path):
    ran = run("report", calibration, "--out", tmp_path / "r.html")
    assert ran.code == 0
    assert "Good for precision assembly" in ran.out
    assert "No held-out error" in ran.out
    assert ran.out.splitlines()[-1].startswith("next: evercal verify ")
    page = (tmp_path / "r.html").read_text()
    # The image; the camera with its ellipsoid, and the residuals.
    assert page.count('src="data:image/') == 1
    assert page.count('<figure class="chart">') == 2
    assert "images used; 1 rejected" in page
    assert not re.search(r"(?:src|href)=\"(?!data:)|https?://", page)


def test_json_with_an_older_calibration(run, calibration, tmp_path):
    moved = SE3.exp([0.003, 0.0, 0.004, 0, 0, 0]) @ POSE
    Calibration("eye_to_hand", moved, 1e-8 * np.eye(6)).write(tmp_path / "old.json")
    out = tmp_path / "r.html"
    words = (
        "--images",
        tmp_path / "a.png",
        "--against",
        tmp_path / "old.json",
        "--out",
        out,
    )
    ran = run("report", calibration, *words, "--json")
    record = ran.json
    assert ran.code == 0
    assert record["tier"] == "precision assembly"
    assert record["pictures"] == [str(tmp_path / "a.png")]
    assert record["against"]["translation_mm"] == pytest.approx(5.0)
    assert record["against"]["rotation_deg"] == pytest.approx(0.0, abs=1e-6)
    assert record["expected_error_mm"] == pytest.approx(0.1732, abs=1e-4)
    assert any("No landmarks" in sentence for sentence in record["missing"])
    assert "from old.json" in out.read_text()


@pytest.mark.parametrize(
    ("camera", "message"),
    [(None, "no intrinsics"), (CAMERA, "names no images; pass some")],
)
def test_calibration_without_images_or_camera(run, tmp_path, camera, message):
    own = Calibration("eye_in_hand", POSE, 1e-4 * np.eye(6), camera=camera)
    own.write(tmp_path / "s.json")
    ran = run("report", tmp_path / "s.json", "--out", tmp_path / "r.html", "--json")
    assert ran.code == 0
    record = ran.json
    assert record["tier"] is None
    assert record["pictures"] == []
    assert any(message in sentence for sentence in record["missing"])
