"""Every example in docs/formats.md is read by the reader of its format."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.boards.layout_files import layout_readings, read_tags
from evercal.calibration.picked_points import read_picks, read_points
from evercal.calibration.transform_file import read_transform
from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings import (
    ReadOptions,
    Recording,
    load_recording,
    read_robot_poses,
    write_image,
)
from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.formats import lerobot, wrist
from evercal.recordings.formats.lerobot_poses import pose_feature
from evercal.recordings.poses.joint_tables import read_joints
from evercal.robot.joint_map import JointMap

from .checks import assert_pose

PAGE = Path(__file__).parents[2] / "docs" / "formats.md"
TEXT = PAGE.read_text() + Path(__file__).with_name("more_examples.md").read_text()
EXAMPLES = dict(re.findall(r"^```\w+ (\S+)\n(.*?)^```$", TEXT, re.M | re.S))
CAMERA = Camera(640, 480, 525.2, 526.5, 319.5, 239.3, (0.1, -0.02, 0.001, 0.0, 0.03))
POSES = SE3(
    np.array([[0, 1, 0, 0], [0.0998, 0.995, 0, 0]]),
    np.array([[0.412, 0.031, 0.553], [0.436, 0.018, 0.561]]),
)
# By folder: images that the example names, and the expected numbers of frames.
RECORDINGS = {
    "kitchen": (["images/000000.png"], 1, 0),
    "wave": (["image-1.png", "image-2.png"], 2, 0),
    "timed": (["image-1.png", "image-2.png"], 2, 0),
    "walk": (["image-1.png", "image-2.png"], 2, 0),
    "redkitchen": (
        ["seq-01/frame-000000.color.png", "seq-02/frame-000000.color.png"],
        1,
        1,
    ),
    "apartment": (["data/frame-000000.color.jpg", "data/frame-000001.color.jpg"], 1, 1),
    "phone": (["images/frame_00001.png"], 0, 1),
    "house": (["images/0001.jpg"], 1, 0),
}
SINGLE_FILES = {
    "joints.csv", "joints.json", "camera.txt", "touched.csv", "picks.csv", "base_from_camera.txt",
    "pusht/meta/info.json", "layout.csv", "joint_map.json",
}  # fmt: skip
CAMERAS = {
    "camera.json", "camera_info.yaml", "camera_opencv.yaml", "camera_opencv.json",
    "camera_realsense.json",
}  # fmt: skip
CHAINS = {"camchain.yaml", "orb_slam.yaml"}
POSE_FILES = {
    "poses.csv": None, "kuka.txt": "kuka", "poses.tum": None, "kitti.txt": None,
    "matrices.txt": None, "ur.script": None, "frames.dat": None, "poses.json": None,
    "arrays.json": None, "named.json": None, "echo.yaml": None, "echo.txt": None,
    "targets.mod": None, "echo.csv": "xyzw",
}  # fmt: skip
"""Examples with their conventions."""
NAMED = (
    "poses.csv",
    "kuka.txt",
    "ur.script",
    "frames.dat",
    "poses.json",
    "arrays.json",
    "named.json",
)
TIMED = ("poses.csv", "poses.tum", "poses.json", "echo.yaml", "echo.txt")


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """All examples as files."""
    for name, text in EXAMPLES.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return tmp_path


def test_every_example_is_read_here() -> None:
    assert TEXT.count("```") == 2 * len(EXAMPLES)
    files = SINGLE_FILES | CAMERAS | CHAINS | POSE_FILES.keys()
    assert {name.split("/")[0] for name in EXAMPLES if name not in files} == set(
        RECORDINGS
    )
    assert set(EXAMPLES) >= files


def recording(page: Path, name: str) -> Recording:
    root = page / name
    for image in RECORDINGS[name][0]:
        (root / image).parent.mkdir(parents=True, exist_ok=True)
        write_image(root / image, np.zeros((480, 640, 3), np.uint8))
        pose = root / image.replace(".color.png", ".pose.txt").replace(
            ".color.jpg", ".pose.txt"
        )
        if pose.suffix == ".txt" and not pose.exists():
            pose.write_text(EXAMPLES["base_from_camera.txt"])
    camera = page / "camera.json" if name == "timed" else None
    return load_recording(root, options=ReadOptions(camera=camera))


@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings(page: Path, name: str) -> None:
    read = recording(page, name)
    assert (len(read.train), len(read.test)) == RECORDINGS[name][1:]
    for frame in (*read.train, *read.test):
        assert frame.read_image().shape == (480, 640, 3)
        pose = frame.base_from_camera
        if pose is not None:
            np.testing.assert_allclose(pose.translation_m, [0.4, 0, 0.6])
            np.testing.assert_allclose(
                pose.rotation_matrix(), np.diag([1, -1, -1]), atol=1e-12
            )
    if name == "wave":
        assert_poses(read)


def assert_poses(read: Recording) -> None:
    for frame, expected in zip(read.train, POSES, strict=True):
        assert_pose(frame.base_from_gripper, expected, 1e-4)


@pytest.mark.parametrize("name", sorted(CAMERAS))
def test_camera_files(page: Path, name: str) -> None:
    assert read_camera(page / name) == CAMERA
    expected = Camera(640, 480, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
    assert read_camera(page / "camera.txt", (640, 480)) == expected


@pytest.mark.parametrize("name", sorted(CHAINS))
def test_cameras_inside_other_entries(page: Path, name: str) -> None:
    camera = read_camera(page / name)
    assert camera.coefficients == (*CAMERA.distortion[:4], 0, 0, 0, 0)
    assert replace(camera, distortion=CAMERA.distortion) == CAMERA


@pytest.mark.parametrize(("name", "convention"), POSE_FILES.items())
def test_pose_files(page: Path, name: str, convention: str | None) -> None:
    read = read_robot_poses(page / name, convention)
    metres, radians = pose_distance(read.poses, POSES)
    assert metres.max() < 1e-9
    assert radians.max() < 2e-3
    assert read.names == (("image-1.png", "image-2.png") if name in NAMED else None)
    assert name not in TIMED or (read.stamps_s is not None and read.stamps_s[1] == 10.1)


def test_joint_tables(page: Path) -> None:
    for name in ("joints.csv", "joints.json"):
        rows = read_joints(page / name)
        assert rows.names == ("image-1.png", "image-2.png")
        np.testing.assert_allclose(rows.values[:, :2], [[0.12, -1.53], [0.18, -1.49]])
    assert wrist.detect(page)


def test_joint_maps(page: Path) -> None:
    read = JointMap.read(page / "joint_map.json")
    assert read.joints == ("wrist_flex", "elbow_flex", "wrist_roll")
    values = read.values(np.full((1, len(read.columns)), 10.0))
    np.testing.assert_allclose(np.rad2deg(values), [[80, 20, 20]])


def test_lerobot_description(page: Path) -> None:
    assert lerobot.detect(page / "pusht")
    info = json.loads((page / "pusht" / lerobot.INFO).read_text())
    assert pose_feature(page / "pusht", info, ReadOptions()) == "observation.ee"


def test_touched_points(page: Path) -> None:
    assert [*read_points(page / "touched.csv")] == ["corner", "screw", "edge"]
    first = read_picks(page / "picks.csv")[0]
    assert first[:2] == ("images/a.jpg", "corner")
    np.testing.assert_allclose(first.pixel, [311.5, 204.0])


def test_layout_of_tags(page: Path) -> None:
    tags = read_tags(page / "layout.csv")
    assert [tag["size"] for tag in tags.values()] == [[0.04], [0.04]]
    layout = next(layout_readings(tags, 1.0))
    np.testing.assert_allclose(layout[3].mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(layout[7] - layout[3], [[0.12, 0.01, 0]] * 4, atol=1e-12)


def test_matrix(page: Path) -> None:
    np.testing.assert_allclose(
        read_transform(page / "base_from_camera.txt").translation_m, [0.4, 0, 0.6]
    )
