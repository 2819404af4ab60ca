"""Episodes in the layout of DROID's raw data."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.episodes import episodes_in
from evercal.recordings.episodes.episode import Episode
from evercal.recordings.read_options import ReadOptions
from evercal.robot.robot_model import RobotModel

from ..formats.test_lerobot import URDF, picture, write_video

h5py: Any = pytest.importorskip("h5py", reason="the extra 'droid' is not installed")
pytest.importorskip("av", reason="the extra 'droid' is not installed")
NAME = "LAB+0123abcd+2023-07-08-12h-00m-00s"
SERIALS = ("111", "222")
JOINTS = "observation/robot_state/joint_positions"


def write_episode(root: Path, name: str = NAME) -> Path:
    """An episode of seven steps; the arm stands still at the third."""
    folder = root / "LAB/success/2023-07-08" / name
    values = np.array([[0, 0], [1, 0], [2, 0], [2, 0], [2, 0], [3, 0], [4, 0.1]])
    folder.mkdir(parents=True)
    with h5py.File(folder / "trajectory.h5", "w") as file:
        file[JOINTS] = values
    data: dict[str, Any] = {"uuid": name}
    for number, serial in enumerate(SERIALS):
        data[f"ext{number + 1}_cam_serial"] = serial
        data[f"ext{number + 1}_cam_extrinsics"] = [number, 0, 1, 0, 0, 0.5]
        shown = [picture(number, i) for i in range(len(values))]
        write_video(folder / f"recordings/MP4/{serial}.mp4", shown, "libx264")
    (folder / f"metadata_{name}.json").write_text(json.dumps(data))
    return folder


def read(root: Path, camera: object = None) -> tuple[int, list[Episode]]:
    (root / "arm.urdf").write_text(URDF)
    lens = {"width": 96, "height": 64, "fx": 80, "fy": 80, "cx": 47.5, "cy": 31.5}
    (root / "lens.json").write_text(json.dumps(camera or lens))
    model = RobotModel(root / "arm.urdf")
    total, found = episodes_in(root, model, root / "lens.json", ReadOptions(), 1)
    return total, [*found]


def test_images_joints_and_poses(tmp_path: Path) -> None:
    write_episode(tmp_path)
    total, episodes = read(tmp_path)
    assert total == 2
    for number, episode in enumerate(episodes):
        assert (episode.name, episode.camera) == (NAME, SERIALS[number])
        assert episode.joints == ("shoulder", "reach")
        poses = [(0, 0, 1, 0, 0, 0.5), (1, 0, 1, 0, 0, 0.5)]
        assert dict(episode.stated) == dict(zip(SERIALS, poses, strict=True))
        (frame,) = episode.frames
        assert frame.joints_rad == (2, 0)
        difference = frame.read_image().astype(int) - picture(number, 3)
        assert np.abs(np.median(difference, (0, 1))).max() < 6


def test_each_camera_of_each_episode_has_its_own_intrinsics(tmp_path: Path) -> None:
    write_episode(tmp_path)
    # DROID's order: fx, cx, fy, cy.
    entry = {"cameraMatrix": [80, 47, 81, 31], "width": 96, "height": 64}
    cameras = {NAME: dict.fromkeys(SERIALS, entry)}
    _, episodes = read(tmp_path, cameras)
    assert episodes[1].frames[0].camera == Camera(96, 64, 80, 81, 47, 31)
    del cameras[NAME]["222"]
    (episode,) = read(tmp_path, cameras)[1]
    assert "lens.json: has no camera 222 of LAB+" in episode.problem


def broken_table(folder: Path) -> None:
    (folder / "trajectory.h5").write_bytes(b"no table")


def endless_table(folder: Path) -> None:
    with h5py.File(folder / "trajectory.h5", "w") as file:
        file.create_dataset(JOINTS, (10**8, 7), "f4", chunks=True)


def table_elsewhere(folder: Path) -> None:
    (folder / "trajectory.h5").rename(folder / "other.h5")
    with h5py.File(folder / "trajectory.h5", "w") as file:
        file[JOINTS] = h5py.ExternalLink("other.h5", JOINTS)


def no_video(folder: Path) -> None:
    (folder / "recordings/MP4/222.mp4").unlink()


def path_as_number(folder: Path) -> None:
    (file,) = folder.glob("metadata_*.json")
    file.write_text(file.read_text().replace('"222"', '"../222"'))


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (broken_table, r"trajectory\.h5: cannot be read"),
        (endless_table, r"trajectory\.h5.*joint values, at most"),
        (table_elsewhere, r"trajectory\.h5.*lies in another file"),
        (no_video, r"222\.mp4: video is missing; download it too"),
        (path_as_number, r"metadata_LAB.*stays inside the folder"),
    ],
)
def test_a_damaged_episode_does_not_end_the_reading(
    damage: Any, problem: str, tmp_path: Path
) -> None:
    damage(write_episode(tmp_path))
    write_episode(tmp_path, "later")
    broken, *whole = read(tmp_path)[1]
    assert not broken.frames
    assert [episode.name for episode in whole] == ["later", "later"]
    assert re.search(problem, broken.problem)


def test_a_folder_without_episodes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no data set; give the folder of meta/info"):
        read(tmp_path)
