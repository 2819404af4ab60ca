"""Poses in text: printed by programs, under headers, in encodings, and what is unclear."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from evercal.recordings.poses.robot_poses import read_robot_poses

from ..checks import refused
from .test_pose_data import M, R, T, assert_arm, numbers


def table(rows: list[list[float]], header: str = "", separator: str = ",") -> str:
    lines = [separator.join(map(repr, row)) for row in rows]
    return "\n".join([header.replace(",", separator)] * bool(header) + lines)


def turned(name: str) -> list[list[float]]:
    """Rows with the rotation first."""
    return [[*row[3:], *row[:3]] for row in numbers(name)]


Form = Callable[[int, list[float]], str]
PRINTED: dict[str, tuple[str, str | None, Form]] = {
    "tf2_echo": ("xyzw", None, lambda i, r: f"At time {i}.5\n- Translation: {r[:3]}\n- Rotation:"
                 f" in Quaternion (xyzw) {r[3:]}\n- Rotation: in RPY (radian) [0, 0, 0]\n"
                 "- Matrix:\n 1 2 3 4"),
    "robtarget": ("abb", None, lambda i, r: f"CONST robtarget p{i}:=[{r[:3]},{r[3:]},[0,0,0,0],"
                  "[9E9,9E9,9E9,9E9,9E9,9E9]];"),
    "pairs of lists": ("xyzw", "xyzw", lambda _, r: f"{r[:3]} {r[3:]}"),
    "FANUC": ("fanuc", None, lambda i, r: f"P[{i}]{{\n GP1:\n UF : 0, UT : 1,\n X = {r[0]} mm, Y ="
              f" {r[1]} mm, Z = {r[2]} mm,\n W = {r[3]} deg, P = {r[4]} deg, R = {r[5]} deg\n}};"),
    "Mitsubishi": ("yaskawa", "mitsubishi", lambda i, r: f"P{i}={tuple(r)}"),
    "Epson": ("kuka", "epson", lambda i, r: f"P{i} = XY{tuple(r)}"),
    "Doosan": ("kawasaki", "doosan", lambda _, r: f"posx{tuple(r)}"),
    "URScript": ("ur", None, lambda _, r: f"  movel(p{r}, a=1.2, v=0.25)"),
    "names": ("wxyz", "wxyz", lambda i, r: f"im{i}.png: {str(r)[1:-1]}"),
    "plain titles": ("matrix", None, lambda i, r: f"Pose{i}:\n{np.reshape(r, (4, 4))}"),
    "titles": ("matrix", None, lambda i, r: f"Pose {i}:\n{np.reshape(r, (4, 4))}"),
    "assigned": ("matrix", None, lambda i, r: f"T_{i} = {np.reshape(r, (4, 4)).tolist()}"),
    "repr": ("matrix", None, lambda _, r: repr(np.reshape(r, (4, 4)))),
}  # fmt: skip


@pytest.mark.parametrize("kind", PRINTED)
def test_printed_poses_are_read(tmp_path: Path, kind: str) -> None:
    written, given, form = PRINTED[kind]
    lines = [form(i, row) for i, row in enumerate(numbers(written))]
    (tmp_path / "p.txt").write_text("\n".join(lines))
    read = assert_arm(tmp_path / "p.txt", given)
    if kind == "tf2_echo":
        np.testing.assert_allclose(read.stamps_s, np.arange(5) + 0.5)


HEADED = [
    ("alpha,beta,gamma,x,y,z", turned("yaskawa"), "yaskawa"),
    ("quat1,quat2,quat3,quat4,x,y,z", turned("wxyz"), "wxyz"),
    ("X,Y,Z,A,B,C", numbers("yaskawa"), "mitsubishi"),
    ("X,Y,Z,W,P,R", numbers("kuka"), "kuka"),
    ("X,Y,Z,U,V,W", numbers("kuka"), "epson"),
    ("X,Y,Z,O,A,T", numbers("kawasaki"), None),
    ("x,y,z,rx,ry,rz", numbers("kawasaki"), "doosan"),
    ("x,y,z,rx,ry,rz", numbers("moving_xyz"), "moving_xyz"),
    ("X [mm],Y [mm],Z [mm],Roll [°],Pitch [°],Yaw [°]", numbers("yaskawa"), None),
    ("x (mm),y (mm),z (mm),rx (°),ry (°),rz (°)", numbers("yaskawa"), "rpy"),
    ("x/mm,y/mm,z/mm,roll/deg,pitch/deg,yaw/deg", numbers("yaskawa"), None),
    (
        "r11,r12,r13,r21,r22,r23,r31,r32,r33,x,y,z",
        np.c_[R.reshape(5, 9), T].tolist(),
        None,
    ),
    (
        "x_mm,y_mm,z_mm,r00,r01,r02,r10,r11,r12,r20,r21,r22",
        np.c_[1000 * T, R.reshape(5, 9)].tolist(),
        None,
    ),
    (
        "n,x,y,z,a1,a2,a3",
        [[i, *row] for i, row in enumerate(numbers("staubli"))],
        "staubli",
    ),
]


@pytest.mark.parametrize(("header", "rows", "given"), HEADED)
def test_a_stated_convention_wins_over_letters(
    tmp_path: Path, header: str, rows: list[list[float]], given: str | None
) -> None:
    (tmp_path / "p.csv").write_text(table(rows, header), encoding="utf-8")
    assert_arm(tmp_path / "p.csv", given)


WXYZ = "x,y,z,qw,qx,qy,qz"


@pytest.mark.parametrize(
    "encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"]
)
def test_encodings_are_recognised(tmp_path: Path, encoding: str) -> None:
    text = table(numbers("kuka"), "X [mm],Y [mm],Z [mm],A [°],B [°],C [°]")
    (tmp_path / "p.csv").write_bytes(text.replace("\n", "\r\n").encode(encoding))
    assert_arm(tmp_path / "p.csv", "kuka")


@pytest.mark.parametrize("separator", [";", "\t", " "])
@pytest.mark.parametrize("header", [WXYZ, ""])
def test_commas_may_be_decimal_beside_other_separators(
    tmp_path: Path, separator: str, header: str
) -> None:
    rows = table(numbers("wxyz"), "", separator).replace(".", ",")
    head = header.replace(",", separator) + "\n" * bool(header)
    (tmp_path / "p.txt").write_text(head + rows)
    assert_arm(tmp_path / "p.txt", None if header else "wxyz")


@pytest.mark.parametrize(
    ("text", "given", "problem"),
    [
        (table(turned("kuka")), "kuka", "before the position; give .* A,B,C,X,Y,Z:kuka"),
        (table(turned("wxyz")), "wxyz", "the rotation is before the position"),
        (table([[i, *row] for i, row in enumerate(turned("ur:mm"))]), "ur:mm", "before the pos"),
        (table(np.c_[R.reshape(5, 9), T].tolist()), None, "or a header r11,r12,r13"),
        (table(numbers("wxyz"), "x_cm,y_cm,z_cm,qw,qx,qy,qz"), None, "are in cm; write m or mm"),
        (table(numbers("kuka"), "x,y,z,rx,ry,rz"), "kuka", "name them as 'X Y Z A B C'"),
        (table(numbers("kuka"), "X,Y,Z,A,B,C"), None, "kuka .A about z. or mitsubishi .A about x"),
        (table(numbers("kuka"), "X,Y,Z,U,V,W"), None, "give the convention epson"),
        (table(numbers("kuka")), "kukka", "not known, kuka is"),
        (table(numbers("wxyz")) + f"\n{M[0]}", "wxyz", "all poses with brackets, or none"),
        (f"p{numbers('ur')[0]}\n{table(numbers('ur'))}", None, "is beside poses in p"),
        ("x;y;z;rx;ry;rz\n1,234;0.5;3;1;2;3", "ur:mm:deg", "'1,234' is not a finite number"),
        ("\n".join(f"P{i}={tuple(r)}(7,0)" for i, r in enumerate(numbers("kuka"))), "kuka", "8 nu"),
    ],
)  # fmt: skip
def test_what_is_unclear_is_refused_with_a_way_on(
    tmp_path: Path, text: str, given: str | None, problem: str
) -> None:
    (tmp_path / "p.txt").write_text(text)
    refused(problem, read_robot_poses, tmp_path / "p.txt", given)
