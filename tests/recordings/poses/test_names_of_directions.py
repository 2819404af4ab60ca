"""Keys that name the direction of a transform: the inverse is never read as the pose."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.robot_poses import read_robot_poses

POSES = SE3.exp(np.random.default_rng(0).normal(0, 0.5, (10, 6)))
RIGHT = (
    "base_T_ee T_world_gripper tcp_in_base H_base_flange bTe gripper_to_base world_from_hand T_b_e"
    " T_ee2base ee2base flange2base tool_to_base base_from_tcp base_link_T_tool0 T_base_eef"
)
INVERSE = (
    "ee_T_base T_gripper_world base_in_tcp H_flange_base eTb hand_from_world T_e_b ee_from_base"
    " gripper_from_base tool_from_base tcp_from_robot camera_from_world base2ee world2hand"
    " T_base2ee base_to_tool base_to_gripper base_2_flange board_from_camera R_base2gripper"
)


def written(folder: Path, key: str, poses: SE3, each: bool) -> Path:
    """A file of matrices under a key: an object for each pose, or one list."""
    matrices = poses.matrix().tolist()
    data: object = {key: matrices}
    if each:
        data = [{key: matrix} for matrix in matrices]
    path = folder / "poses.json"
    path.write_text(json.dumps(data))
    return path


@pytest.mark.parametrize("each", [True, False])
@pytest.mark.parametrize("key", RIGHT.split())
def test_right_names_are_read(key: str, each: bool, tmp_path: Path) -> None:
    read = read_robot_poses(written(tmp_path, key, POSES, each))
    assert read.poses.matrix() == pytest.approx(POSES.matrix(), abs=1e-9)


@pytest.mark.parametrize("each", [True, False])
@pytest.mark.parametrize("key", INVERSE.split())
def test_names_of_inverses_are_refused(key: str, each: bool, tmp_path: Path) -> None:
    path = written(tmp_path, key, POSES.inverse(), each)
    with pytest.raises(InputError, match=f"{key} is the inverse of the pose by its"):
        read_robot_poses(path)
    read = read_robot_poses(path, "matrix:inverse")
    assert read.poses.matrix() == pytest.approx(POSES.matrix(), abs=1e-9)


def test_a_quaternion_is_no_rotation_vector(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    rows = np.c_[POSES.translation_m, POSES.rotation_wxyz]
    header = "pos_x,pos_y,pos_z,rot_w,rot_x,rot_y,rot_z"
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    assert read_robot_poses(path).poses.matrix() == pytest.approx(POSES.matrix())
    with pytest.raises(InputError, match="rot_w"):
        read_robot_poses(path, "ur")


@pytest.mark.parametrize(
    ("header", "first"),
    [
        ("x(mm),y(mm),z(mm),Rx(deg),Ry(deg),Rz(deg)", "rpy"),
        ("x,y,z,alpha,beta,gamma", "staubli"),
    ],
)
def test_the_first_reading_that_is_offered(
    header: str, first: str, tmp_path: Path
) -> None:
    """Degrees are no rotation vector; Mecademic's letters are angles about moving axes."""
    path = tmp_path / "poses.csv"
    path.write_text(f"{header}\n100,200,300,10,20,30\n130,200,300,-170,20,30\n")
    with pytest.raises(InputError, match=rf"give the convention {first} \("):
        read_robot_poses(path)


def test_posx_of_doosan(tmp_path: Path) -> None:
    angles = POSES.rotation.as_euler("ZYZ", degrees=True)
    rows = np.c_[1000 * POSES.translation_m, angles]
    lines = [f"P{i} = posx({', '.join(map(str, row))})" for i, row in enumerate(rows)]
    path = tmp_path / "poses.txt"
    path.write_text("\n".join(lines))
    read = read_robot_poses(path)
    assert read.poses.matrix() == pytest.approx(POSES.matrix(), abs=1e-9)
