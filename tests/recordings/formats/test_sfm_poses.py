"""Poses of structure from motion in place of the original ones."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.recordings import ReadOptions, Recording, load_recording, write_image

from ..checks import refused

# A quarter turn about y, then a metre along z: camera_from_world.
LINE = "0.70710678 0 0.70710678 0 0 0 1 527.745"


@pytest.fixture
def heads(tmp_path: Path) -> Path:
    """Three training images and a test image; the first has no original pose."""
    root = tmp_path / "heads"
    for sequence, count in ((1, 1), (2, 3)):
        folder = root / f"seq-0{sequence}"
        folder.mkdir(parents=True)
        for i in range(count):
            stem = folder / f"frame-{i:06d}"
            write_image(stem.with_suffix(".color.png"), np.zeros((48, 64, 3), np.uint8))
            np.savetxt(stem.with_suffix(".pose.txt"), np.eye(4))
    np.savetxt(root / "seq-02/frame-000000.pose.txt", np.full((4, 4), -np.inf))
    (root / "TrainSplit.txt").write_text("sequence2")
    (root / "TestSplit.txt").write_text("sequence1")
    return root


def write(folder: Path, train: list[str], test: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "heads_train.txt").write_text("\n".join(train) + "\n")
    (folder / "heads_test.txt").write_text("\n".join(test) + "\n")


def read(root: Path, folder: Path) -> Recording:
    return load_recording(root, options=ReadOptions(poses=str(folder)))


def test_poses_are_replaced_and_other_frames_dropped(
    heads: Path, tmp_path: Path
) -> None:
    # Any order, any extension. Frame 1 is not in the reconstruction, frame 0 is in it alone.
    assert load_recording(heads).untracked == 1
    train = [f"seq-02/frame-00000{i}.color.png {LINE}" for i in (2, 0)]
    write(tmp_path, train, [f"seq-01/frame-000000.color.png {LINE}"])
    result = read(heads, tmp_path)
    assert [f.name for f in result.train] == [
        "seq-02/frame-000000",
        "seq-02/frame-000002",
    ]
    assert result.untracked == 1
    pose = result.test[0].base_from_camera
    assert pose is not None
    rotation = Rotation.from_euler("y", 90, degrees=True)
    expected = np.eye(4)
    expected[:3, :3] = rotation.inv().as_matrix()
    expected[:3, 3] = rotation.inv().apply([0.0, 0.0, -1.0])
    np.testing.assert_allclose(pose.matrix(), expected, atol=1e-7)
    assert result.test[0].camera.fx == result.test[0].camera.fy == 527.745
    # The middle of the image, independent of the original calibration.
    camera = result.test[0].camera
    assert (camera.cx + 0.5, camera.cy + 0.5) == (camera.width / 2, camera.height / 2)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "seq-01/frame-000000.color.png 1 0 0 0 0 nan 0 500",
            "row 1, column 'ty': 'nan' is not a finite number",
        ),
        ("seq-01/frame-000000.color.png 1 0 0 0 0 0 0 -5", "camera fx"),
        ("seq-01/frame-000000.color.png 0 0 0 0 0 0 0 500", "SE3 got a quaternion of"),
        (f"seq-07/frame-000000.color.png {LINE}", "no frame of .*heads is in it"),
    ],
)
def test_broken_files_are_refused(
    heads: Path, tmp_path: Path, line: str, message: str
) -> None:
    write(tmp_path, [f"seq-02/frame-000000.color.png {LINE}"], [line])
    refused(rf"heads_test\.txt: {message}", read, heads, tmp_path)
    (tmp_path / "heads_test.txt").unlink()
    message = r"heads_test\.txt: pose file is missing; get the folder"
    refused(message, read, heads, tmp_path)


def test_another_folder_of_the_repository_is_told_from_the_right_one(
    heads: Path,
    tmp_path: Path,
) -> None:
    right = tmp_path / "pgt/sfm/7scenes"
    lines = [f"seq-02/frame-000000.color.png {LINE}"]
    write(right, lines, [f"seq-01/frame-000000.color.png {LINE}"])
    other = tmp_path / "pgt/sfm/12scenes"
    other.mkdir()
    original = tmp_path / "pgt/dslam/7scenes"
    write(original, lines, lines)
    for folder in (tmp_path, tmp_path / "pgt", right.parent, other, original):
        refused(f"motion; give `poses` {right}$", read, heads, folder)
    assert len(read(heads, right).train) == 1
