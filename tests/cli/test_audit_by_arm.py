"""`audit --urdf`: camera poses of a data set, by the arm in its images."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3
from evercal.recordings.poses.conventions import numbers_from_poses, pose_convention
from evercal.robot.link_shapes import robot_body
from evercal.robot.robot_model import RobotModel
from tests import arm_cell

pa: Any = pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")
pytest.importorskip("av", reason="the extra 'lerobot' is not installed")
TRUTH = arm_cell.BASE_FROM_CAMERA
STATED = "camera_extrinsics.side"
IMAGES = 8


def numbers(pose: SE3, convention: str = "rpy") -> list[float]:
    return numbers_from_poses(pose, pose_convention(convention)).tolist()


POSES = (
    numbers(TRUTH),
    numbers(TRUTH.inverse()),
    numbers(TRUTH, "rpy:mm"),
    numbers(SE3.exp([0.03, -0.02, 0.01, 0.01, 0, 0.01]) @ TRUTH),
)
"""What episodes state."""


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LeRobot data set whose episodes have the same images."""
    import pyarrow.parquet as pq

    root = tmp_path_factory.mktemp("data")
    (root / "robot.urdf").write_text(arm_cell.urdf())
    values = arm_cell.joint_values(IMAGES)
    body = robot_body(RobotModel(root / "robot.urdf"), arm_cell.NAMES)
    cells = []
    for image in arm_cell.images(body, values):
        png = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
        cells.append({"bytes": png, "path": None})
    for number, pose in enumerate(POSES):
        columns = {
            "episode_index": [number] * IMAGES,
            "timestamp": (np.arange(IMAGES) / 10).tolist(),
            "frame_index": [*range(IMAGES)],
            "observation.state": values.tolist(),
            "observation.images.side": cells,
            STATED: [pose] * IMAGES,
        }
        file = root / f"set/data/chunk-000/episode_{number:06d}.parquet"
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(columns), file)
    size = [arm_cell.CAMERA.height, arm_cell.CAMERA.width, 3]
    features = {
        "observation.state": {"dtype": "float32", "names": arm_cell.NAMES},
        "observation.images.side": {"dtype": "image", "shape": size},
        STATED: {"dtype": "float32", "shape": [6]},
    }
    info = {"codebase_version": "v2.1", "fps": 10, "total_episodes": len(POSES)}
    (root / "set/meta").mkdir()
    (root / "set/meta/info.json").write_text(json.dumps({**info, "features": features}))
    names = ("width", "height", "fx", "fy", "cx", "cy")
    camera = {name: getattr(arm_cell.CAMERA, name) for name in names}
    (root / "camera.json").write_text(json.dumps(camera))
    return root


def test_wrong_poses_are_found_named_and_repaired(run, data_set, tmp_path):
    out = tmp_path / "poses.json"
    command = ("audit", data_set / "set", "--urdf", data_set / "robot.urdf")
    command += ("--camera", data_set / "camera.json", "--out", out, "--workers", "1")
    ran = run(*command)
    assert ran.code == 1
    first, second, third, last = ran.out.splitlines()
    assert first.startswith(
        f"wrong    episode_000001 {STATED}: inverse: stated pose is"
    )
    assert f"episode_000002 {STATED}: other unit of length: " in second
    # The pose in the images is another one than in the episode before.
    assert re.search(
        rf"episode_000003 {STATED}: stated pose is [34]. mm and 0.8", third
    )
    assert last == "3 of 4 camera poses are wrong, 0 unknown"
    written = json.loads(out.read_text())
    poses = [episode[STATED] for episode in written["extrinsics"].values()]
    np.testing.assert_allclose(poses[:3], [POSES[0]] * 3, atol=1e-6)
    np.testing.assert_allclose(poses[3], POSES[0], atol=0.005)
    seconds = [episode["seconds"] for episode in written["episodes"]]
    # Results are kept, and the data set is unchanged.
    again = run.json(*command)
    assert again == written
    assert [episode["seconds"] for episode in again["episodes"]] == seconds
    # Other options have results of their own.
    run(*command, "--most-mm", "40", "--images", "2")
    assert len([*tmp_path.glob("*.rows")]) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("set --urdf robot.urdf", "give the folder of one data set, intrinsics"),
        (
            "set set --urdf robot.urdf --camera camera.json --out o",
            "folder of one data set",
        ),
        ("set", "give MAP and DIR; or a data set alone, with --urdf and --camera"),
        (
            ". --urdf robot.urdf --camera camera.json --out o",
            "no data set; give the folder",
        ),
        (
            "set --urdf no.urdf --camera camera.json --out o",
            "no.urdf: no such URDF file",
        ),
        (
            "set --urdf robot.urdf --camera camera.json --out o --pose-convention euler",
            "pose convention 'euler' is not known",
        ),
        (
            "set --urdf robot.urdf --camera camera.json --out o --without claw",
            "has no link claw",
        ),
    ],
)
def test_bad_input_is_refused(run, data_set, monkeypatch, words, message):
    monkeypatch.chdir(data_set)
    assert message in run.refused("audit", words)
