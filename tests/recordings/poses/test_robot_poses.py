"""Pose files: every kind is read, and ambiguous files need a convention."""

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.conventions import (
    CONVENTIONS,
    numbers_from_poses,
    pose_convention,
)
from evercal.recordings.poses.robot_poses import read_robot_poses
from evercal.typing import Array

from ..checks import refused

COUNT = 6


def arm(seed: int = 0) -> SE3:
    """Poses of a gripper half a metre from its base."""
    rng = np.random.default_rng(seed)
    return SE3(rng.normal(size=(COUNT, 4)), rng.uniform(0.2, 0.8, (COUNT, 3)))


def table(header: str, numbers: Array, separator: str = ",") -> str:
    text = io.StringIO()
    writer = csv.writer(text, delimiter=separator)
    if header:
        writer.writerow(header.split(","))
    writer.writerows(numbers.tolist())
    return text.getvalue()


def same(poses_read: SE3, poses: SE3, tolerance: float = 1e-12) -> bool:
    return poses_read.shape == poses.shape and bool(
        np.max(pose_distance(poses_read, poses)) < tolerance
    )


HEADERS = [
    ("x,y,z,qw,qx,qy,qz", "wxyz", None),
    ("tx,ty,tz,qx,qy,qz,qw", "xyzw", None),
    ("X,Y,Z,Q_W,Q_X,Q_Y,Q_Z", "wxyz", None),
    ("pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,pose.orientation.y,"
     "pose.orientation.z,pose.orientation.w", "xyzw", None),
    ("translation_x,translation_y,translation_z,rotation_x,rotation_y,rotation_z,rotation_w",
     "xyzw", None),
    ("x_mm,y_mm,z_mm,qw,qx,qy,qz", "wxyz:mm", None),
    ("x [mm],y [mm],z [mm],qw [],qx [],qy [],qz []", "wxyz:mm", None),
    ("x_m,y_m,z_m,rotvec_x,rotvec_y,rotvec_z", "ur", None),
    ("x,y,z,rvec_x_deg,rvec_y_deg,rvec_z_deg", "ur:deg", None),
    ("x,y,z,roll_deg,pitch_deg,yaw_deg", "rpy:deg", None),
    ("x(m),y(m),z(m),roll (rad),pitch (rad),yaw (rad)", "rpy", None),
    ("X,Y,Z,W,P,R", "fanuc", None),
    (",".join(f"m{i}{j}" for i in range(4) for j in range(4)), "matrix", None),
    (",".join(f"m{i}{j}" for j in range(4) for i in range(4)), "franka", None),
    (",".join(f"O_T_EE[{i}]" for i in range(16)), "franka", None),
    (",".join(f"O_T_EE_{i}" for i in range(16)), "franka", "franka"),
    (",".join(f"actual_TCP_pose_{i}" for i in range(6)), "ur", None),
    ("ee_pos_x,ee_pos_y,ee_pos_z,ee_quat_x,ee_quat_y,ee_quat_z,ee_quat_w", "xyzw", None),
    ("p_x,p_y,p_z,q_w,q_x,q_y,q_z", "wxyz", None),
    (",".join(f"/tcp/pose/position/{i}" for i in "xyz") + ","
     + ",".join(f"/tcp/pose/orientation/{i}" for i in "xyzw"), "xyzw", None),
    ("x,y,z,rx,ry,rz", "ur", "ur"),
    ("x,y,z,rx,ry,rz", "yaskawa", "yaskawa"),
    ("x,y,z,rx,ry,rz", "staubli", "staubli"),
    ("x,y,z,yaw,pitch,roll", "kuka", "kuka"),
    ("x,y,z,roll,pitch,yaw", "rpy:deg", "rpy:deg"),
    ("X,Y,Z,A,B,C", "kuka", "kuka"),
    ("x,y,z,q1,q2,q3,q4", "abb", "abb"),
    ("x,y,z,q1,q2,q3,q4", "xyzw", "xyzw"),
    ("x,y,z,qw,qx,qy,qz", "wxyz:inverse", "wxyz:inverse"),
    ("x_m,y_m,z_m,A,B,C", "kuka:m", "kuka:m"),
    ("p1,p2,p3,o1,o2,o3", "staubli", "staubli"),
]  # fmt: skip


@pytest.mark.parametrize(("header", "written", "given"), HEADERS)
def test_headers_define_columns(
    tmp_path: Path, header: str, written: str, given: str | None
) -> None:
    numbers = numbers_from_poses(arm(), pose_convention(written))
    file = tmp_path / "poses.csv"
    for separator in (",", ";", "\t"):
        file.write_text(table(header, numbers, separator))
        read = read_robot_poses(file, given)
        assert same(read.poses, arm())
        assert (read.names, read.stamps_s) == (None, None)


def test_lines_of_ros2_topic_echo_csv_are_read(tmp_path: Path) -> None:
    """A PoseStamped: seconds, nanoseconds, frame, position and quaternion."""
    rows = numbers_from_poses(arm(), pose_convention("xyzw")).tolist()
    text = "".join(
        f"{1700000000 + i},250000000,base,{str(row)[1:-1]}\n"
        for i, row in enumerate(rows)
    )
    (tmp_path / "p.csv").write_text(text)
    read = read_robot_poses(tmp_path / "p.csv", "xyzw")
    assert same(read.poses, arm())
    assert read.stamps_s is not None
    np.testing.assert_allclose(read.stamps_s - 1.7e9, np.arange(len(rows)) + 0.25)


@given(st.permutations(range(9)), st.integers(0, 1000))
@settings(max_examples=30)
def test_columns_may_be_in_any_order(
    tmp_path_factory: pytest.TempPathFactory, order: list[int], seed: int
) -> None:
    header = ["x", "y", "z", "qw", "qx", "qy", "qz", "stamp", "image"]
    numbers = numbers_from_poses(arm(seed), CONVENTIONS["wxyz"])
    rows = [
        [*map(repr, row.tolist()), f"{i}.5", f"{i}.png"]
        for i, row in enumerate(numbers)
    ]
    lines = [",".join(row[k] for k in order) for row in [header, *rows]]
    file = tmp_path_factory.getbasetemp() / "shuffled.csv"
    file.write_text("\n".join(lines))
    read = read_robot_poses(file)
    assert same(read.poses, arm(seed))
    assert read.names == tuple(f"{i}.png" for i in range(COUNT))
    assert read.stamps_s is not None
    np.testing.assert_array_equal(read.stamps_s, np.arange(COUNT) + 0.5)


@pytest.mark.parametrize("name", sorted(CONVENTIONS))
@pytest.mark.parametrize("extra", ["", "name", "stamp", "stamp name", "name stamp"])
def test_tables_without_header_are_read(tmp_path: Path, name: str, extra: str) -> None:
    lines = ["# made by a robot"]
    for i, row in enumerate(numbers_from_poses(arm(), CONVENTIONS[name])):
        before = {"": "", "name": f"{i}.png ", "stamp": f"{i}.5 "}.get(
            extra, f"{i}.5 {i}.png "
        )
        lines.append(before + " ".join(map(repr, row.tolist())))
    file = tmp_path / "poses.txt"
    file.write_text("\n".join(lines))
    read = read_robot_poses(file, name)
    assert same(read.poses, arm())
    assert (read.names is not None) == ("name" in extra)
    assert (read.stamps_s is not None) == ("stamp" in extra)


def test_tum_files_are_read(tmp_path: Path) -> None:
    numbers = numbers_from_poses(arm(), CONVENTIONS["xyzw"])
    lines = [
        f"{1.7e9 + i} " + " ".join(map(repr, row.tolist()))
        for i, row in enumerate(numbers)
    ]
    (tmp_path / "a.tum").write_text("\n".join(lines))
    (tmp_path / "b.txt").write_text(
        "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines)
    )
    (tmp_path / "c.txt").write_text("# ground truth\n" + "\n".join(lines))
    for name, message in (("a.tum", None), ("b.txt", None), ("c.txt", "tum")):
        read = read_robot_poses(tmp_path / name, message)
        assert same(read.poses, arm())
        assert read.stamps_s is not None
        assert read.stamps_s[2] == 1.7e9 + 2
    inverse = read_robot_poses(tmp_path / "c.txt", "tum:inverse")
    assert same(inverse.poses, arm().inverse())
    refused(
        r"what the 8 columns are .* give the convention xyzw or wxyz",
        read_robot_poses,
        tmp_path / "c.txt",
    )


def test_decimal_commas_are_read(tmp_path: Path) -> None:
    text = table("image,x,y,z,qw,qx,qy,qz", np.array([[0]]), ";").splitlines()[0]
    (tmp_path / "p.csv").write_text(
        text + "\na,b.png;0,5;0,25;0,1;1;0;0;0\n", encoding="utf-8-sig"
    )
    read = read_robot_poses(tmp_path / "p.csv")
    np.testing.assert_array_equal(read.poses.translation_m, [[0.5, 0.25, 0.1]])
    assert read.names == ("a,b.png",)


def test_json_is_read(tmp_path: Path) -> None:
    file = tmp_path / "p.json"
    poses = arm()
    matrices = arm().matrix()
    objects = [
        {
            "translation_m": p.translation_m.tolist(),
            "quaternion_wxyz": p.rotation_wxyz.tolist(),
        }
        for p in poses
    ]
    kuka = numbers_from_poses(poses, CONVENTIONS["kuka"]).tolist()
    for data, convention, expected in (
        (objects, None, poses),
        ({"poses": objects}, None, poses),
        (objects, "wxyz:inverse", poses.inverse()),
        (objects[0], None, poses[:1]),
        ([{"matrix": m.tolist()} for m in matrices], None, poses),
        ([{"matrix": m.T.ravel().tolist()} for m in matrices], "franka", poses),
        (matrices.tolist(), None, poses),
        (kuka, "kuka", poses),
    ):
        file.write_text(json.dumps(data))
        assert same(read_robot_poses(file, convention).poses, expected)
    refused(
        "what the 6 columns are .* give the convention kuka", read_robot_poses, file
    )


def test_npy_files_are_read(tmp_path: Path) -> None:
    file = tmp_path / "p.npy"
    matrices = arm().matrix()
    np.save(file, matrices[0])
    assert same(read_robot_poses(file).poses, arm()[:1])
    np.save(file, matrices.swapaxes(1, 2))
    assert same(read_robot_poses(file, "franka").poses, arm())
    refused(
        "written column after column; give the convention franka",
        read_robot_poses,
        file,
    )
    for name in ("wxyz", "xyzw", "ur", "kuka", "franka"):
        np.save(file, numbers_from_poses(arm(), CONVENTIONS[name]))
        assert same(read_robot_poses(file, name).poses, arm())
        if name != "franka":
            refused("what the [67] columns are", read_robot_poses, file)
    assert same(read_robot_poses(file).poses, arm())


def test_given_convention_overrides_the_header(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("x_m,y_m,z_m,qw,qx,qy,qz\n500,100,200,1,0,0,0")
    read = read_robot_poses(tmp_path / "p.csv", "wxyz:mm")
    np.testing.assert_allclose(read.poses.translation_m, [[0.5, 0.1, 0.2]])
