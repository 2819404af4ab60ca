"""Files of tracked streams, read back by other readers."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.localization.tracking import TrackedFrame
from evercal.reports.track_files import TrackFile, track_row

POSE = SE3.exp([0.3, -0.2, 1.1, 0.4, -0.3, 2.0])
CAMERA = Camera(64, 48, 60.0, 61.0, 31.5, 23.5, (0.1, -0.02, 0.0, 0.0))


def frames() -> list[TrackedFrame]:
    good = PoseEstimate("ok", "", "room", POSE, np.eye(6), 9, 1.0, 2.0, camera=CAMERA)
    bad = PoseEstimate("failed", "too dark", None, None, None, 0, 0.0, 2.0)
    return [
        TrackedFrame(0, 1700000000.25, "relocalized", good),
        TrackedFrame(1, 1700000000.5, "lost", bad),
        TrackedFrame(2, 1700000000.75, "tracking", good),
    ]


def write(path: Path) -> Path:
    with TrackFile(path) as file:
        for frame in frames():
            file.write(frame, track_row(frame, f"{frame.number}.png"))
    return path


def test_json_lines_hold_every_frame(tmp_path: Path) -> None:
    rows = [
        json.loads(line)
        for line in write(tmp_path / "t.jsonl").read_text().splitlines()
    ]
    assert [row["state"] for row in rows] == ["relocalized", "lost", "tracking"]
    assert [row["stamp_s"] for row in rows] == [frame.stamp_s for frame in frames()]
    assert rows[0]["base_from_camera"]["matrix"] == POSE.matrix().tolist()
    assert (rows[1]["base_from_camera"], rows[1]["reason"]) == (None, "too dark")


def test_tum_lines_have_the_scalar_last(tmp_path: Path) -> None:
    rows = np.loadtxt(write(tmp_path / "t.tum"))
    assert rows[:, 0] == pytest.approx([1700000000.25, 1700000000.75], abs=1e-6)
    assert rows[0, 1:4] == pytest.approx(POSE.translation_m, abs=1e-9)
    matrix = Rotation.from_quat(rows[0, 4:]).as_matrix()
    assert matrix == pytest.approx(POSE.rotation_matrix(), abs=1e-8)


def test_other_endings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ends with .jsonl, .tum, .txt"):
        TrackFile(tmp_path / "track.bin")
    assert not list(tmp_path.iterdir())
