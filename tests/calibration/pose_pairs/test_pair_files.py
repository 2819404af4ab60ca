"""Pairing of two pose files, and messages that name the right file and option."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from evercal.calibration.pose_pairs.pair_files import PairFiles, read_pairs
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance


def write(file: Path, names: list[str]) -> Path:
    """Write poses half a metre from the base; pose i is at i centimetres along y."""
    rows = [f"{name},0.5,{i / 100},0.2,1,0,0,0" for i, name in enumerate(names)]
    file.write_text("\n".join(["image,x,y,z,qw,qx,qy,qz", *rows]))
    return file


def test_names_are_paired_without_folder_and_suffix(tmp_path: Path) -> None:
    robot = write(tmp_path / "robot.csv", ["1.25", "1.50", "1.75"])
    camera = write(
        tmp_path / "camera.csv", ["rgb/1.75.png", "rgb/1.25.png", "rgb/1.50.png"]
    )
    pairs, _ = read_pairs(PairFiles(robot, camera))
    assert_allclose(pairs.base_from_gripper.translation_m[:, 1], [0.02, 0, 0.01])


def test_names_that_match_partly_are_shown(tmp_path: Path) -> None:
    robot = write(
        tmp_path / "robot.csv", ["a-1.png", "a-2.png", "a-03.png", "a-04.png"]
    )
    camera = write(tmp_path / "camera.csv", ["a-1.png", "rgb\\a-2.png", "a-3.png"])
    pairs, _ = read_pairs(PairFiles(robot, camera))
    assert len(pairs.names) == 2
    assert pairs.notes == (
        "1 image without a row in robot.csv: a-3.png (nearest: a-03.png)",
        "2 rows of robot.csv without an image: a-03.png, a-04.png",
    )


def test_names_that_differ_only_in_their_folder_are_refused(tmp_path: Path) -> None:
    robot = write(tmp_path / "robot.csv", ["left/1.png", "right/1.png"])
    camera = write(tmp_path / "camera.csv", ["1.png"])
    with pytest.raises(
        InputError, match=r"robot\.csv: 'left/1\.png' comes twice, apart from"
    ):
        read_pairs(PairFiles(robot, camera))


@pytest.mark.parametrize("role", ["robot", "camera"])
def test_messages_name_the_file_and_its_option(tmp_path: Path, role: str) -> None:
    robot, camera = (
        write(tmp_path / f"{name}.csv", ["1", "2"]) for name in ("robot", "camera")
    )
    broken = tmp_path / f"{role}.csv"
    broken.write_text("1 2 3 4 5 6\n")
    with pytest.raises(InputError, match=rf"{role}\.csv: .*`{role}_convention`"):
        read_pairs(PairFiles(robot, camera))
    broken.unlink()
    with pytest.raises(
        InputError, match=f"file of {role} poses is missing; check `{role}_poses`"
    ):
        read_pairs(PairFiles(robot, camera))


@pytest.mark.parametrize("inverted", [False, True])
def test_opengl_flips_the_side_of_the_camera(tmp_path: Path, inverted: bool) -> None:
    rng = np.random.default_rng(2)
    camera_from_board = SE3(rng.normal(size=(3, 4)), rng.uniform(0.2, 0.8, (3, 3)))
    stated = np.diag([1.0, -1.0, -1.0, 1.0]) @ camera_from_board.matrix()
    np.save(tmp_path / "camera.npy", np.linalg.inv(stated) if inverted else stated)
    robot = write(tmp_path / "robot.csv", ["1", "2", "3"])
    files = PairFiles(
        robot,
        tmp_path / "camera.npy",
        camera_convention="matrix:opengl",
        invert="camera" if inverted else None,
    )
    pairs, _ = read_pairs(files)
    assert np.max(pose_distance(pairs.camera_from_board, camera_from_board)) < 1e-12


def test_camera_poses_in_json_are_a_table_unless_they_are_of_a_board(
    tmp_path: Path,
) -> None:
    robot = write(tmp_path / "robot.csv", ["1", "2", "3"])
    pose = {"x": 0.5, "y": 0.0, "z": 0.2, "qw": 1, "qx": 0, "qy": 0, "qz": 0}
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps([{"image": name, **pose} for name in "123"]))
    pairs, corners = read_pairs(PairFiles(robot, camera))
    assert len(pairs.camera_from_board) == 3
    assert corners is None
