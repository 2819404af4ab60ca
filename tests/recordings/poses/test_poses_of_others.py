"""Poses as other programs write and print them: each form gives the same poses."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.conventions import (
    CAMERA_AXES,
    numbers_from_poses,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.poses.robot_poses import read_robot_poses

from ..checks import refused

RNG = np.random.default_rng(3)
POSES = SE3(RNG.normal(size=(5, 4)), RNG.uniform(0.2, 0.8, (5, 3)))
OTHERS = SE3(RNG.normal(size=(5, 4)), RNG.uniform(0.2, 0.8, (5, 3)))
MATRICES = POSES.matrix()


def numbers(name: str) -> np.ndarray:
    return numbers_from_poses(POSES, pose_convention(name))


def words(row: Any) -> str:
    return " ".join(map(repr, np.ravel(row).tolist()))


def listed(row: Any) -> str:
    return ", ".join(map(repr, np.ravel(row).tolist()))


def lines(rows: Any, before: str = "", after: str = "") -> str:
    return "".join(
        f"{before.format(i)}{words(row)}{after}\n" for i, row in enumerate(rows)
    )


def first_rotation(name: str) -> np.ndarray:
    return np.roll(numbers(name), -3, axis=1)


def printed(form: Callable[[np.ndarray, np.ndarray, np.ndarray], str]) -> str:
    rows = zip(MATRICES, POSES.translation_m, POSES.rotation_wxyz, strict=True)
    with np.printoptions(precision=17):
        return "\n".join(form(*row) for row in rows)


COLUMNS = "qw,qx,qy,qz,x,y,z"
TEXTS = {
    "hloc's results": (
        lines(first_rotation("wxyz:inverse"), "db/{}.jpg "),
        f"{COLUMNS}:inverse",
    ),
    "ACE's poses with errors and inliers": (
        lines(first_rotation("wxyz:inverse"), "{}.color.png ", " 0.1 0.02 900"),
        f"image,{COLUMNS},...:inverse",
    ),
    "ACE0's poses_final.txt": (
        lines(first_rotation("wxyz:inverse"), "rgb/{}.png ", " 525.0 2200"),
        f"image,{COLUMNS},focal,confidence:inverse",
    ),
    "TUM with the quaternion first": (
        lines(first_rotation("wxyz"), "17{}.25 "),
        f"stamp,{COLUMNS}",
    ),
    "vectors before positions": (
        lines(first_rotation("ur")),
        "rotvec_x,rotvec_y,rotvec_z,x,y,z",
    ),
    "KUKA's angles before millimetres": (
        lines(first_rotation("kuka")),
        "A,B,C,X,Y,Z:kuka",
    ),
    "six numbers of DROID": (lines(numbers("rpy")), "rpy"),
    "six numbers under names": (
        lines(numbers("rpy:deg")),
        "x,y,z,roll_deg,pitch_deg,yaw_deg",
    ),
    "a header that is not known": (
        "e_x e_y e_z e_a e_b e_c e_d\n" + lines(numbers("xyzw")),
        "x,y,z,qx,qy,qz,qw",
    ),
    "Redwood's and Open3D's log": (
        "".join(f"{i} {i} {i + 1}\n{lines(m)}" for i, m in enumerate(MATRICES)),
        None,
    ),
    "Tanks and Temples' log": (
        "".join(f"{i}\t{i}\t0\n{lines(m)}" for i, m in enumerate(MATRICES)).rstrip(),
        None,
    ),
    "autolab_core's RigidTransform, printed": (
        printed(
            lambda m, t, q: f"Tra: {t}\n Rot: {m[:3, :3]}\n Qtn: {q}\n from a to b"
        ),
        None,
    ),
    "frankapy's log": (
        printed(
            lambda m, t, q: (
                f"INFO pose Tra: {t}\n Rot: {m[:3, :3]}\n Qtn: {q}\n from tool to world"
            )
        ),
        None,
    ),
    "repr of RigidTransform": (
        printed(
            lambda m, t, _: (
                f"RigidTransform(rotation=np.{m[:3, :3]!r}, translation=np.{t!r}, x)"
            )
        ),
        None,
    ),
    "SAPIEN's poses": (
        printed(lambda _, t, q: f"Pose([{listed(t)}], [{listed(q)}])"),
        None,
    ),
    "poses of ManiSkill by name": (
        printed(lambda _, t, q: f"grasp: Pose(p=[{listed(t)}], q=[{listed(q)}])"),
        None,
    ),
    "Pinocchio's SE3": (
        printed(lambda m, t, _: f"  R =\n{lines(m[:3, :3])}  p = {words(t)}\n"),
        None,
    ),
    "Blender's matrices": (
        printed(
            lambda m, _t, _q: (
                "<Matrix 4x4 " + "\n ".join(f"({listed(r)})" for r in m) + ">"
            )
        ),
        None,
    ),
    "PyBullet's view matrices": (
        lines(numbers("franka:inverse:opengl")),
        "franka:inverse:opengl",
    ),
    "MuJoCo's cameras": (lines(numbers("wxyz:opengl")), "wxyz:opengl"),
    "Isaac's cameras in world axes": (
        lines(numbers("wxyz:x_forward")),
        "wxyz:x_forward",
    ),
    "PyTorch3D's and CoppeliaSim's": (lines(numbers("matrix:x_left")), "matrix:x_left"),
}


def assert_poses(read: SE3, expected: SE3 = POSES, tolerance: float = 1e-7) -> None:
    assert read.shape == expected.shape
    assert np.max(pose_distance(read, expected)) < tolerance


@pytest.mark.parametrize("form", TEXTS)
def test_texts_of_other_programs_are_read(tmp_path: Path, form: str) -> None:
    text, convention = TEXTS[form]
    (tmp_path / "p.txt").write_text(text)
    assert_poses(read_robot_poses(tmp_path / "p.txt", convention).poses)


@pytest.mark.parametrize(("number", "axes"), [(0, "moving_xyz"), (2, "fixed_xyz")])
def test_halcon_poses_are_read(tmp_path: Path, number: int, axes: str) -> None:
    """Type 0 is R = Rx(a) Ry(b) Rz(c), type 2 the reverse; degrees from 0 to 360, metres."""
    for i, row in enumerate(numbers(f"{axes}:deg")):
        text = (
            f"#\n# 3D POSE PARAMETERS: rotation and translation\n#\n\n# Used representation type:\n"
            f"f {number}\n\n# Rotation angles [deg] or Rodriguez-vector:\n"
            f"r {words(row[3:] % 360)}\n\n# Translational vector (x y z [m]):\nt {words(row[:3])}\n"
        )
        (tmp_path / f"robot_pose_{i:02d}.dat").write_text(text)
    assert_poses(read_robot_poses(tmp_path).poses)


def test_autolab_tf_files_are_read(tmp_path: Path) -> None:
    for i, matrix in enumerate(MATRICES):
        text = f"tool\nworld\n{words(matrix[:3, 3])}\n{lines(matrix[:3, :3])}"
        (tmp_path / f"T_tool_world_{i}.tf").write_text(text)
    assert_poses(read_robot_poses(tmp_path).poses)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "f 4\nr 0.1 0.2 0.3\nt 1 2 3\n",
            "HALCON's representation type 4; write type 0",
        ),
        ("f 9\nr 10 20 30\nt 1 2 3\n", "HALCON's representation type 9"),
        (
            f"0 1 90\n{lines(MATRICES[0])}0 2 90\n{lines(MATRICES[1])}",
            "motions between pairs of fragments, the first 0 1; give the trajectory",
        ),
    ],
)
def test_what_states_no_poses_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "p.dat").write_text(text)
    refused(message, read_robot_poses, tmp_path / "p.dat")


def pose(i: int, poses: SE3, keys: str = "position orientation") -> dict[str, Any]:
    position, rotation = keys.split()
    w, x, y, z = poses.rotation_wxyz[i].tolist()
    return {
        position: dict(zip("xyz", poses.translation_m[i].tolist(), strict=True)),
        rotation: {"x": x, "y": y, "z": z, "w": w},
    }


def header(i: int) -> dict[str, Any]:
    stamp = {"secs": 1700000000 + i, "nsecs": 5}
    return {"seq": i, "stamp": stamp, "frame_id": "camera"}


def covered(i: int, poses: SE3 = POSES) -> dict[str, Any]:
    return {"pose": pose(i, poses), "covariance": [0.0] * 36}


def tag(i: int, number: int, poses: SE3 = POSES) -> dict[str, Any]:
    stamped = {"header": header(i), "pose": covered(i, poses)}
    return {"id": [number], "size": [0.05], "pose": stamped}


def moved(i: int, child: str, poses: SE3 = POSES) -> dict[str, Any]:
    transform = pose(i, poses, "translation rotation")
    return {"header": header(i), "child_frame_id": child, "transform": transform}


def fiducial(i: int) -> dict[str, Any]:
    return {"fiducial_id": 110, "transform": pose(i, POSES, "translation rotation")}


MESSAGES: dict[str, tuple[Callable[[int], dict[str, Any]], str | None]] = {
    "apriltag_ros": (lambda i: {"detections": [tag(i, 4)]}, None),
    "apriltag_ros, one of two": (
        lambda i: {"detections": [tag(i, 4), tag(i, 14, OTHERS)]},
        "xyzw:tag4",
    ),
    "aruco_ros": (lambda i: {"markers": [{"id": 582, "pose": covered(i)}]}, None),
    "aruco_opencv": (
        lambda i: {"markers": [{"marker_id": 3, "pose": pose(i, POSES)}], "boards": []},
        None,
    ),
    "ar_track_alvar": (
        lambda i: {"markers": [{"id": 2, "pose": {"pose": pose(i, POSES)}}]},
        None,
    ),
    "ros2_aruco": (lambda i: {"marker_ids": [7], "poses": [pose(i, POSES)]}, None),
    "fiducials": (lambda i: {"image_seq": i, "transforms": [fiducial(i)]}, None),
    "tf of tags": (
        lambda i: {
            "transforms": [
                moved(i, "tag36h11:4"),
                moved(i, "tag36h11:14", OTHERS),
            ]
        },
        "xyzw:tag4",
    ),
    "PoseStamped": (lambda i: {"pose": pose(i, POSES)}, None),
    "PoseWithCovarianceStamped": (lambda i: {"pose": covered(i)}, None),
    "TransformStamped": (lambda i: moved(i, "tool0"), None),
    "tf": (lambda i: {"transforms": [moved(i, "tool0")]}, None),
}


def written(folder: Path, messages: list[dict[str, Any]]) -> Path:
    """An echo of messages, without references."""
    texts = []
    for i, message in enumerate(messages):
        plain = json.loads(json.dumps({"header": header(i), **message}))
        texts.append(yaml.safe_dump(plain, sort_keys=False) + "---\n")
    (folder / "echo.yaml").write_text("".join(texts))
    return folder / "echo.yaml"


@pytest.mark.parametrize("topic", MESSAGES)
def test_echoes_of_topics_are_read(tmp_path: Path, topic: str) -> None:
    message, convention = MESSAGES[topic]
    file = written(tmp_path, [message(i) for i in range(5)])
    read = read_robot_poses(file, convention, robot=False)
    assert_poses(read.poses)
    assert read.stamps_s is not None
    assert read.stamps_s[1] - read.stamps_s[0] == 1


def test_messages_without_a_detection_are_no_poses(tmp_path: Path) -> None:
    messages = [{"detections": [tag(i, 4)] if i != 2 else []} for i in range(5)]
    read = read_robot_poses(written(tmp_path, messages), robot=False)
    assert_poses(read.poses, POSES[np.array([0, 1, 3, 4])])


def test_several_tags_are_asked_for(tmp_path: Path) -> None:
    messages = [{"detections": [tag(i, 4), tag(i, 14)]} for i in range(3)]
    file = written(tmp_path, messages)
    message = r"of the tags \[4\], \[14\]; give --c of one, such as xyzw:tag4"
    refused(message, read_robot_poses, file, option="--c")
    refused("no message holds a pose of this tag", read_robot_poses, file, "xyzw:tag5")
    twice = written(tmp_path, [{"markers": [tag(i, 4), tag(i, 4)]} for i in range(3)])
    refused(r"tag \[4\] is twice in one message", read_robot_poses, twice)


@pytest.mark.parametrize("axes", CAMERA_AXES)
def test_camera_axes_turn_the_camera_only(axes: str) -> None:
    """OpenCV's x is right, y down, z forward."""
    directions = {
        "opengl": ([1, 0, 0], [0, -1, 0], [0, 0, -1]),
        "x_forward": ([0, -1, 0], [0, 0, -1], [1, 0, 0]),
        "x_left": ([-1, 0, 0], [0, -1, 0], [0, 0, 1]),
    }
    turn = np.eye(4)
    turn[:3, :3] = np.transpose(directions[axes])
    stated = MATRICES @ np.linalg.inv(turn)
    rows = stated.reshape(5, 16)
    assert_poses(poses_from_numbers(rows, pose_convention(f"matrix:{axes}")))
    camera_from = (turn @ MATRICES).reshape(5, 16)
    convention = pose_convention(f"matrix:{axes}")
    assert_poses(poses_from_numbers(camera_from, convention, camera_from=True))
