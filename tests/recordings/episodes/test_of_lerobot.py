"""Episodes of LeRobot data sets whose features state camera poses."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.recordings.episodes import episodes_in
from evercal.recordings.episodes.episode import Episode, slow_rows, values_of_joints
from evercal.recordings.episodes.of_lerobot import stated_features
from evercal.recordings.read_options import ReadOptions
from evercal.robot.robot_model import RobotModel

from ..formats import test_lerobot

pq: Any = pytest.importorskip("pyarrow.parquet")
pa: Any = pytest.importorskip("pyarrow")
WRIST = test_lerobot.WRIST
STATED = "camera_extrinsics.wrist"


def made(root: Path, version: str, kind: str) -> Path:
    """A data set whose wrist camera has a stated pose, other in each episode."""
    test_lerobot.make(root, version, kind)
    info = json.loads((root / "meta/info.json").read_text())
    info["features"][STATED] = {"dtype": "float32", "shape": [6]}
    (root / "meta/info.json").write_text(json.dumps(info))
    for file in root.glob("data/*/*.parquet"):
        table = pq.read_table(file)
        poses = []
        for episode in table["episode_index"].to_pylist():
            poses.append([episode, 0.5, 1.0, 0.1, 0.2, 0.3])
        pq.write_table(table.append_column(STATED, pa.array(poses)), file)
    (root / "arm.urdf").write_text(test_lerobot.URDF)
    return root


def read(root: Path, **more: Any) -> tuple[int, list[Episode]]:
    model = RobotModel(root / "arm.urdf")
    options = ReadOptions(**{"image_topic": WRIST, **more})
    total, episodes = episodes_in(root, model, root / "lens.txt", options, 3)
    return total, [*episodes]


@pytest.mark.parametrize(
    ("version", "kind"), [("v2.1", "video"), ("v3.0", "video"), ("v3.0", "image")]
)
def test_images_joints_and_poses(version: str, kind: str, tmp_path: Path) -> None:
    total, episodes = read(made(tmp_path, version, kind))
    assert total == len(episodes) == test_lerobot.EPISODES
    # As they come to a worker process.
    for number, episode in enumerate(pickle.loads(pickle.dumps(episodes))):
        assert (episode.name, episode.camera) == (f"episode_{number:06d}", STATED)
        assert episode.joints == ("shoulder", "reach")
        stated = [number, 0.5, 1.0, 0.1, 0.2, 0.3]
        assert episode.stated[STATED] == pytest.approx(stated)
        assert len(episode.frames) == 3
        for frame in episode.frames:
            step = round(frame.joints_rad[1] / 0.05)
            expected = test_lerobot.joints(number, step)
            np.testing.assert_allclose(frame.joints_rad, expected)
            shown = test_lerobot.picture(number, step)
            difference = frame.read_image().astype(int) - shown
            assert np.abs(np.median(difference, (0, 1))).max() < 6


def test_fixed_cameras_are_chosen_by_their_names() -> None:
    keys = ("images.cam_1", "images.cam_10", "images.wrist", "images.hand")
    stated = ("camera_extrinsics.cam_10", "extrinsics_cam_1", "camera_extrinsics.wrist")
    features: dict[str, Any] = {key: {"dtype": "video"} for key in keys}
    features |= {key: {} for key in stated}
    info = {"features": features}
    found = stated_features(Path(), info, None)
    assert found == {keys[0]: stated[1], keys[1]: stated[0]}
    assert stated_features(Path(), info, keys[2]) == {keys[2]: stated[2]}
    assert stated_features(Path(), info, keys[3]) == {keys[3]: ""}
    for name in stated:
        del features[name]
    with pytest.raises(InputError, match="4 cameras; name one with `image_topic`"):
        stated_features(Path(), info, None)


def test_numbers_without_joint_names_are_joints_from_the_base(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(test_lerobot.URDF)
    model = RobotModel(tmp_path / "arm.urdf")
    values = np.array([[90.0, 0.1, 1.0]])
    names = ["joint_0", "joint_1", "Gripper"]
    joints, radians = values_of_joints(model, names, values, "deg")
    assert joints == ("shoulder", "reach")
    np.testing.assert_allclose(radians, [[np.pi / 2, 0.1]])
    with pytest.raises(InputError, match=r"has 2 joints that move.*states 3; give"):
        values_of_joints(model, ["a", "b", "c"], values, None)


def test_images_are_taken_where_the_arm_is_slow() -> None:
    values = np.array([0, 0, 1, 2, 3, 3, 3, 5, 7, 7.0])[:, None]
    assert slow_rows(values, 2) == [0, 5]
    assert slow_rows(values[:1], 5) == [0]


def test_a_matrix_and_a_pose_that_is_missing(tmp_path: Path) -> None:
    """Tables hold a matrix as rows, and nan where an episode states none."""
    made(tmp_path, "v2.1", "video")
    for i, file in enumerate(sorted(tmp_path.glob("data/*/*.parquet"))):
        table = pq.read_table(file).drop_columns([STATED])
        pose = np.full((4, 4), 0.5)
        pose[0, 3] = [0.5, np.nan, 0.5][i]
        poses = [pose.tolist()] * len(table)
        pq.write_table(table.append_column(STATED, pa.array(poses)), file)
    first, second, _ = read(tmp_path)[1]
    assert first.stated[STATED] == (0.5,) * 16
    assert np.isnan(second.stated[STATED]).sum() == 1
