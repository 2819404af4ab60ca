"""Files of tracked streams, read back by other readers."""

import base64
import json
from pathlib import Path

import cv2
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
IMAGE = np.full((48, 64, 3), (200, 100, 50), np.uint8)


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
            file.write(frame, track_row(frame, f"{frame.number}.png"), IMAGE)
    return path


def test_json_lines_hold_every_frame(tmp_path: Path) -> None:
    rows = [json.loads(line) for line in write(tmp_path / "t.jsonl").read_text().splitlines()]
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


def test_mcap_messages_are_read_by_the_package_of_the_format(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    with write(tmp_path / "t.mcap").open("rb") as file:
        messages = list(reader.make_reader(file).iter_messages())
    found: dict[str, list[tuple[int, dict]]] = {}
    for schema, channel, message in messages:
        data = (message.log_time, json.loads(message.data))
        found.setdefault(f"{channel.topic} {schema.name}", []).append(data)
    assert {key: len(value) for key, value in found.items()} == {
        "/tf foxglove.FrameTransform": 2,
        "/camera foxglove.CameraCalibration": 2,
        "/image foxglove.CompressedImage": 3,
        "/answer evercal.Answer": 3,
    }
    time, transform = found["/tf foxglove.FrameTransform"][1]
    assert time == 1700000000750000000
    assert transform["timestamp"] == {"sec": 1700000000, "nsec": 750000000}
    assert (transform["parent_frame_id"], transform["child_frame_id"]) == ("base", "camera")
    quaternion = [transform["rotation"][axis] for axis in "xyzw"]
    assert Rotation.from_quat(quaternion).as_matrix() == pytest.approx(POSE.rotation_matrix())
    calibration = found["/camera foxglove.CameraCalibration"][0][1]
    assert calibration["K"] == [60.0, 0, 31.5, 0, 61.0, 23.5, 0, 0, 1]
    picture = base64.b64decode(found["/image foxglove.CompressedImage"][0][1]["data"])
    decoded = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert decoded[20, 20].tolist() == pytest.approx([50, 100, 200], abs=4)


def test_other_endings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ends with .jsonl, .tum, .txt, .mcap"):
        TrackFile(tmp_path / "track.bin")
    assert not list(tmp_path.iterdir())
