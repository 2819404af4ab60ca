"""Calibration files: a round trip, and refusal of files that contradict themselves."""

import json
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.calibration import Calibration, ErrorTerm, ImageUse, read_calibration
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance


def example() -> Calibration:
    return Calibration(
        "eye_in_hand",
        SE3.exp([0.1, -0.2, 0.3, 0.4, -0.5, 0.6]),
        np.diag([1e-6, 1e-6, 4e-6, 1e-8, 1e-8, 4e-8]),
        "panda_hand",
        "camera_color_optical_frame",
        Camera(640, 480, 600, 601, 320, 240),
        (ImageUse("a.png", True, "", 0.5, 0.1), ImageUse("b.png", False, "blurred")),
        (ErrorTerm("map", 0.3, 0.01),),
        {"held_out_mm": 1.5},
        "good for bin picking",
        {"command": "solve"},
        "2026-01-01T00:00:00+00:00",
    )


def test_round_trip(tmp_path: Path) -> None:
    calibration = example()
    calibration.write(tmp_path / "c.json")
    read = read_calibration(tmp_path / "c.json")
    assert max(pose_distance(read.parent_from_child, calibration.parent_from_child)) < 1e-12
    assert read.to_dict() == calibration.to_dict()
    assert read.images == calibration.images
    assert read.meaning.startswith("pose of camera_color_optical_frame in panda_hand")


def test_sigmas_are_root_mean_squares_over_the_axes() -> None:
    assert example().sigma_mm == pytest.approx(1000 * np.sqrt(2e-6))
    assert example().sigma_deg == pytest.approx(np.rad2deg(np.sqrt(2e-8)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "x"}, "'format' is not"),
        ({"version": 2}, "version 2"),
        ({"mount": "eye"}, "'mount'"),
        ({"translation_m": [1, 2, 3]}, "different poses"),
        ({"quaternion_wxyz": [0, 0, 0, 0]}, "length zero"),
        ({"covariance": [[1]]}, "covariance"),
        ({"covariance": (-np.eye(6)).tolist()}, "negative eigenvalue"),
        ({"images": [{"nam": 1}]}, "wrong kind"),
        ({"child_frame": "panda_hand"}, "both called"),
    ],
)
def test_contradictions_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    file = tmp_path / "c.json"
    file.write_text(json.dumps({**example().to_dict(), **change}))
    with pytest.raises(InputError, match=message):
        read_calibration(file)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="missing"):
        read_calibration(tmp_path / "none.json")
    (tmp_path / "text").write_text("hello")
    with pytest.raises(InputError, match="give the JSON"):
        read_calibration(tmp_path / "text")
    data = example().to_dict()
    del data["covariance"]
    (tmp_path / "half").write_text(json.dumps(data))
    with pytest.raises(InputError, match="'covariance' is missing"):
        read_calibration(tmp_path / "half")
