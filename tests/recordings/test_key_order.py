"""The order of keys in JSON and YAML does not matter to any reader."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.poses.joint_tables import read_joints
from evercal.recordings.poses.robot_poses import read_robot_poses
from evercal.storage.text_files import documents

from .cameras.test_camera_file import CALIBRATION, FIELDS, MESSAGE
from .cameras.test_camera_programs import EUROC, KALIBR, ORB_SLAM, VINS, ZIVID
from .poses.test_pose_data import DATA, STAMPED

CAMERAS = [
    *FIELDS,
    *(documents(text, False)[0] for text in (CALIBRATION, MESSAGE, KALIBR)),
    *(documents(text, False)[0] for text in (EUROC, ORB_SLAM, VINS, ZIVID)),
]
POSES = DATA | {"stamped": STAMPED}
POSES["numbered"] = {f"T{i}": each for i, each in enumerate(DATA["R t"])}
JOINTS = {"joint_names": ["a", "b"], "positions": [[1, 2], [3, 4]], "stamps_s": [5, 6]}
SEEDS = pytest.mark.parametrize("seed", range(4))


def shuffled(value: Any, rng: np.random.Generator) -> Any:
    """The same value with the keys of every object in another order."""
    if isinstance(value, list):
        return [shuffled(each, rng) for each in value]
    if not isinstance(value, dict):
        return value
    keys = [*value]
    rng.shuffle(keys)
    return {key: shuffled(value[key], rng) for key in keys}


def files(folder: Path, data: object, seed: int) -> list[Path]:
    """The data as it is, and shuffled in JSON and YAML."""
    plain = json.loads(json.dumps(data))
    other = shuffled(plain, np.random.default_rng(seed))
    texts = {
        "plain.json": json.dumps(plain),
        "other.json": json.dumps(other),
        "other.yaml": yaml.safe_dump(other, sort_keys=False),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    return [folder / name for name in texts]


@SEEDS
@pytest.mark.parametrize("kind", POSES)
def test_poses_do_not_depend_on_the_order_of_keys(
    tmp_path: Path, kind: str, seed: int
) -> None:
    expected, *others = map(read_robot_poses, files(tmp_path, POSES[kind], seed))
    for read in others:
        order = range(len(expected))
        if read.names is not None:
            assert expected.names is not None
            order = [read.names.index(name) for name in expected.names]
        matrices = read.poses.matrix()[order]
        np.testing.assert_array_equal(matrices, expected.poses.matrix())
        np.testing.assert_equal(read.stamps_s, expected.stamps_s)


@SEEDS
@pytest.mark.parametrize("number", range(len(CAMERAS)))
def test_cameras_do_not_depend_on_the_order_of_keys(
    tmp_path: Path, number: int, seed: int
) -> None:
    paths = files(tmp_path, CAMERAS[number], seed)
    expected, *others = (read_camera(path, (640, 480)) for path in paths)
    assert others == [expected, expected]


@SEEDS
def test_joint_values_do_not_depend_on_the_order_of_keys(
    tmp_path: Path, seed: int
) -> None:
    expected, other = map(read_joints, files(tmp_path, JOINTS, seed)[:2])
    np.testing.assert_equal(other, expected)


def test_a_stamp_of_ros_is_read_by_its_keys(tmp_path: Path) -> None:
    """YAML of `safe_dump` has nanosec before sec."""
    (tmp_path / "p.yaml").write_text(yaml.safe_dump_all(STAMPED, sort_keys=True))
    read = read_robot_poses(tmp_path / "p.yaml")
    assert read.stamps_s is not None
    np.testing.assert_allclose(read.stamps_s, np.arange(5) + 0.5)
