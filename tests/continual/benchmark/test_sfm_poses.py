"""Poses of structure from motion in place of the original ones."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.continual.benchmark.sfm_poses import with_sfm_poses
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, Recording

CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
IMAGE = np.zeros((480, 640, 3), np.uint8)


def frame(name: str) -> Frame:
    return Frame(name, IMAGE, CAMERA, SE3.identity())


RECORDING = Recording(
    "heads",
    tuple(frame(f"seq-02/frame-00000{i}") for i in range(3)),
    (frame("seq-01/frame-000000"),),
    untracked=1,
)
# A quarter turn about y, then a metre along z: camera_from_world.
LINE = "0.70710678 0 0.70710678 0 0 0 1 527.745"


def write(folder: Path, train: list[str], test: list[str]) -> None:
    (folder / "heads_train.txt").write_text("\n".join(train) + "\n")
    (folder / "heads_test.txt").write_text("\n".join(test) + "\n")


def test_poses_are_replaced_and_other_frames_dropped(tmp_path: Path) -> None:
    # Any order, any extension; frames 1 is not in the reconstruction.
    train = [f"seq-02/frame-00000{i}.color.png {LINE}" for i in (2, 0)]
    write(tmp_path, train, [f"seq-01/frame-000000.color.png {LINE}"])
    result = with_sfm_poses(RECORDING, tmp_path, "heads")
    assert [f.name for f in result.train] == [
        "seq-02/frame-000000",
        "seq-02/frame-000002",
    ]
    assert result.untracked == 2
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


def test_frames_of_12_scenes_have_no_sequence(tmp_path: Path) -> None:
    recording = Recording(
        "apt1-kitchen", (frame("frame-000357"),), (frame("frame-000001"),)
    )
    (tmp_path / "apt1_kitchen_train.txt").write_text(
        f"data/frame-000357.color.jpg {LINE}\n"
    )
    (tmp_path / "apt1_kitchen_test.txt").write_text(
        f"data/frame-000001.color.jpg {LINE}\n"
    )
    assert len(with_sfm_poses(recording, tmp_path, "apt1_kitchen").train) == 1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "seq-01/frame-000000.color.png 1 0 0 0 0 nan 0 500",
            "line 1 is not 'image qw",
        ),
        ("seq-01/frame-000000.color.png 1 0 0 0 0 0 0 -5", "camera fx"),
        ("seq-01/frame-000000.color.png 0 0 0 0 0 0 0 500", "SE3 got a quaternion of"),
        (f"seq-07/frame-000000.color.png {LINE}", "no frame of heads is in it"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, line: str, message: str) -> None:
    write(tmp_path, [f"seq-02/frame-000000.color.png {LINE}"], [line])
    with pytest.raises(InputError, match=rf"heads_test\.txt: {message}"):
        with_sfm_poses(RECORDING, tmp_path, "heads")
    (tmp_path / "heads_test.txt").unlink()
    with pytest.raises(
        InputError, match=r"heads_test\.txt: pose file is missing; get the folder"
    ):
        with_sfm_poses(RECORDING, tmp_path, "heads")


def test_another_folder_of_the_repository_is_told_from_the_right_one(
    tmp_path: Path,
) -> None:
    right = tmp_path / "pgt/sfm/7scenes"
    right.mkdir(parents=True)
    lines = [f"seq-02/frame-000000.color.png {LINE}"]
    write(right, lines, [f"seq-01/frame-000000.color.png {LINE}"])
    other = tmp_path / "pgt/sfm/12scenes"
    other.mkdir()
    original = tmp_path / "pgt/dslam/7scenes"
    original.mkdir(parents=True)
    write(original, lines, lines)
    for folder in (tmp_path, tmp_path / "pgt", right.parent, other, original):
        with pytest.raises(InputError, match=f"motion; give `poses` {right}$"):
            with_sfm_poses(RECORDING, folder, "heads")
    assert len(with_sfm_poses(RECORDING, right, "heads").train) == 1
