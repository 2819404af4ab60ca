"""Pose files that are ambiguous, broken or missing are refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.recordings.poses.robot_poses import read_robot_poses

from ..checks import refused

Q = "0.5,0.1,0.2,1,0,0,0"
REFUSED = [
    (
        "x,y,z,rx,ry,rz\n0.5,0,0,0.1,0.2,0.3",
        None,
        "give the convention ur .rotation vector. or rpy",
    ),
    (
        "x,y,z,roll,pitch,yaw\n0.5,0,0,0.1,0.2,0.3",
        None,
        "give the convention rpy:rad",
    ),
    (
        "x,y,z,a,b,c\n500,0,0,10,20,30",
        None,
        "columns a, b, c .* give the convention kuka",
    ),
    ("x,y,z,q1,q2,q3,q4\n" + Q, None, "give the convention wxyz or xyzw"),
    (
        "x,y,z,qw,qx,qy,qz,rvec_x,rvec_y,rvec_z\n" + Q + ",0,0,0",
        None,
        "names quaternion and",
    ),
    ("a1,a2,a3,a4,a5,a6,a7\n" + Q, None, "a1, .* name no known pose"),
    ("x,y,z,u,v\n0,0,0,0,0", "kuka", "columns x, y, z, u, v are none of kuka"),
    ("x,y,z,qw,qx,qy,qz\n" + Q, "kuka", "are none of kuka"),
    ("x,y,z,rx,ry,rz\n500,0,0,10,20,30", "kuka", "none of kuka .X Y Z A B C"),
    (
        Q,
        None,
        "no header says what the 7 columns are .*; give the convention xyzw or wxyz",
    ),
    (Q + ",3,4", "wxyz", "rows have 9 numbers; wxyz takes 7"),
    (Q + "\n1,2", "wxyz", "row 2, column 3: '' is not a finite number"),
    ("x,y,z,qw,qx,qy,qz\n0.5,0.1,0.2,1,0,0", None, "row 1, column 'qz': '' is not"),
    (
        "x,y,z,qw,qx,qy,qz\n0.5,0.1,0.2,1,0,0,none",
        None,
        "row 1, column 'qz': 'none' is not a fin",
    ),
    ("x,y,z,qw,qx,qy,qz\n500,100,200,1,0,0,0", None, "look like millimetres.* wxyz:mm"),
    (
        "x_m,y_m,z_m,qw,qx,qy,qz\n500,100,200,1,0,0,0",
        None,
        "look like millimetres.* wxyz:mm",
    ),
    (
        "x,y,z,rotvec_x,rotvec_y,rotvec_z\n0.5,0,0,100,20,3",
        None,
        "look like degrees.* ur:deg",
    ),
    (
        "x_m,y_m,z_m,A,B,C\n500,0,0,100,20,3",
        "kuka",
        "look like millimetres; .* kuka:mm",
    ),
    ("x_m,y,z,qw,qx,qy,qz\n" + Q, None, "x_m, y, z differ in unit"),
    (
        "stamp_s,x,y,z,qw,qx,qy,qz\n1.7e18," + Q,
        None,
        "not in seconds; call the column stamp_ns",
    ),
    ("image,x,y,z,qw,qx,qy,qz\na," + Q + "\na," + Q, None, "'a' comes twice"),
    ("x,y,z,qw,qx,qy,qz\n0.5,0.1,0.2,nan,0,0,0", None, "'nan' is not a finite"),
    ("x,y,z,qw,qx,qy,qz\n0.5,0.1,0.2,1,1,0,0", None, "not of length 1"),
    (
        "x,y,z,qw,qx,qy,qz,px,py,pz\n" + Q + ",1,2,3",
        None,
        "x and px may both be the position's",
    ),
    ("x,y,z,qw,qx,qy,qz,qw,qx,qy,qz\n" + Q + ",1,0,0,0", None, "qw and qw may both be"),
    (
        ",".join(f"{arm}_pos_{i}" for arm in ("left", "right") for i in "xyz")
        + ","
        + ",".join(f"{arm}_quat_{i}" for arm in ("left", "right") for i in "wxyz")
        + "\n0,0,0,0,0,0,1,0,0,0,1,0,0,0",
        None,
        "it holds poses of left_ and right_; keep the columns of one",
    ),
    (
        "left_pos_x,left_pos_y,left_pos_z,right_quat_w,right_quat_x,right_quat_y,right_quat_z\n"
        + Q,
        None,
        "name no known pose",
    ),
    (f"1,5,{Q}\n1,6,{Q}", "wxyz", "rows have 9 numbers"),
    (
        "5,1,2,0,0,1,9\n4,1,2,0,0,1,9",
        "ur",
        "rows have 7 numbers; ur takes 6 .* that increases",
    ),
    ("# nothing\n", None, "no line of numbers"),
    (",,,\n", None, "no line of numbers"),
    ("x,y,z,qw,qx,qy,qz\n", None, "no line of numbers"),
    (Q, "quaternion", "'quaternion' is not known"),
]


@pytest.mark.parametrize(("text", "given", "message"), REFUSED)
def test_ambiguous_and_broken_tables_are_refused(
    tmp_path: Path, text: str, given: str | None, message: str
) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_robot_poses(tmp_path / "p.csv", given)
    assert str(caught.value).startswith(str(tmp_path / "p.csv"))


@pytest.mark.parametrize(
    ("data", "given", "message"),
    [
        (
            [{"translation_m": [1, 2, 3]}],
            None,
            "x_m, y_m, z_m are positions only",
        ),
        (
            [{"translation_m": [1, 2], "quaternion_wxyz": [1, 0, 0, 0]}],
            None,
            "no known pose",
        ),
        (
            [{"translation_m": [1, 2, "x"], "quaternion_wxyz": [1, 0, 0, 0]}],
            None,
            "'x' is not",
        ),
        (
            [{"translation_m": [1, 2, 3], "quaternion_wxyz": [1, 0, 0, 0]}],
            "ur",
            "are none of ur",
        ),
        ([{"matrix": np.eye(4).tolist()}], "kuka", r"got \(1, 4, 4\) for kuka"),
        (
            [{"matrix": np.eye(3).tolist()}],
            None,
            r"or \(n, k\) numbers, got \(1, 3, 3\)",
        ),
        (
            [{"translation_m": [500, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}],
            None,
            "millimetres",
        ),
        ([], None, "a list of objects"),
        ([1, 2], None, "no header says what the 2 columns are"),
        ([[1, 2], {"x": 1}], None, "not of both"),
        ("text", None, "a list of objects"),
    ],
)
def test_broken_json_is_refused(
    tmp_path: Path, data: object, given: str | None, message: str
) -> None:
    (tmp_path / "p.json").write_text(json.dumps(data))
    refused(message, read_robot_poses, tmp_path / "p.json", given)


def test_missing_and_broken_files_are_refused(tmp_path: Path) -> None:
    for name in ("no.csv", "no.json", "no.npy"):
        refused(
            "file of robot poses is missing; check", read_robot_poses, tmp_path / name
        )
    refused(
        "no.csv: camera file is missing",
        read_robot_poses,
        tmp_path / "no.csv",
        what="camera file",
    )
    np.save(tmp_path / "o.npy", np.array([{}, {}], dtype=object), allow_pickle=True)
    np.save(tmp_path / "v.npy", np.zeros((2, 3, 4, 5)))
    for name, content, message in (
        ("b.csv", b"\x80\x00\x81", "not a text file"),
        ("b.json", b"{", r"b\.json: "),
        ("b.npy", b"hello", r"b\.npy: "),
        ("o.npy", None, r"o\.npy: "),
        ("v.npy", None, r"got \(2, 3, 4, 5\)"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        refused(message, read_robot_poses, tmp_path / name)
