"""Tables whose convention is not defined: what is offered is read, and one of it is right."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.conventions import numbers_from_poses, pose_convention
from evercal.recordings.poses.robot_poses import read_robot_poses

from ..checks import refused

RNG = np.random.default_rng(3)
POSES = SE3(RNG.normal(size=(5, 4)), RNG.uniform(0.2, 0.8, (5, 3)))


def rows(name: str, roll: int = 0) -> np.ndarray:
    return np.roll(numbers_from_poses(POSES, pose_convention(name)), roll, axis=1)


def text(table: Any, before: str = "", after: str = "", header: str = "") -> str:
    lines = [header] if header else []
    for i, row in enumerate(table.tolist()):
        lines.append(f"{before.format(i)}{' '.join(map(repr, row))}{after}")
    return "\n".join(lines)


ASKED = {
    "hloc": text(rows("wxyz:inverse", -3), "db/{}.jpg "),
    "ACE0": text(rows("wxyz:inverse", -3), "rgb/{}.png ", " 525.0 1000.0"),
    "ACE": text(rows("wxyz:inverse", -3), "{}.png ", " 0.1 0.2 900"),
    "TUM": text(rows("xyzw"), "170000000{}.5 "),
    "TUM with more columns": text(rows("xyzw"), "170000000{}.5 ", " 1 0.3"),
    "TUM with the quaternion first": text(rows("wxyz", -3), "170000000{}.5 "),
    "w first": text(rows("wxyz")),
    "w first, with a score": text(rows("wxyz"), "{}.png ", " 0.9"),
    "millimetres": text(rows("wxyz:mm")),
    "six numbers": text(rows("rpy")),
    "six numbers of a pendant": text(rows("kuka")),
    "six numbers of another pendant": text(rows("yaskawa")),
    "metres and degrees": text(rows("rpy:deg")),
    "millimetres and radians": text(rows("ur:mm")),
    "names and vectors": text(rows("ur"), "{}.png "),
    "stamps and vectors": text(rows("ur"), "170000000{}.5 "),
    "other words": text(rows("wxyz"), header="a1 a2 a3 a4 a5 a6 a7"),
    "rx of a pendant": text(rows("yaskawa"), header="X Y Z RX RY RZ"),
    "rx of a vector": text(rows("ur"), header="x y z rx ry rz"),
    "A B C": text(rows("kuka"), header="x y z a b c"),
    "q1 in metres": text(rows("wxyz"), header="x y z q1 q2 q3 q4"),
    "q1 in millimetres": text(rows("abb"), header="x y z q1 q2 q3 q4"),
}


@pytest.mark.parametrize("table", ASKED)
def test_what_is_offered_is_read(tmp_path: Path, table: str) -> None:
    file = tmp_path / "p.txt"
    file.write_text(ASKED[table])
    with pytest.raises(InputError) as caught:
        read_robot_poses(file, option="--c")
    message = str(caught.value)
    problem, _, offers = message.partition("; give --c ")
    assert "first row: " in problem
    names = re.sub(r" \([^)]*\)", "", offers).split(" or ")
    assert 1 <= len(names) <= 2
    differences = []
    for name in names:
        for way in (name, f"{name}:inverse"):
            read = read_robot_poses(file, way).poses
            differences.append(np.max(pose_distance(read, POSES)))
    assert min(differences) < 1e-7


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (text(rows("ur")[:, :3]), r"\(0.2\d+ 0.7\d+ 0.3\d+, ...\) are positions only"),
        (text(rows("ur")[:, :3], "{}.png "), r"\('0.png' 0.2\d+ .* are positions only"),
        (text(rows("ur")[:, :3], header="x y z"), "columns x, y, z are positions only"),
        (
            text(rows("ur")[:, :3], "170000000{}.5 ", header="t tx ty tz"),
            "are positions only, poses need rotations: add",
        ),
        (text(rows("ur")[:, :3], "170000000{}.5 "), "times with positions lack the ro"),
        (text(rows("ur")[:, :2]), "2 columns are .* and no usual reading fits; write"),
        (text(rows("ur")[:, :5]), "5 columns are .* and no usual reading fits"),
        (text(RNG.uniform(-1, 1, (5, 7))), r"fits; .* \(joint values belong into joi"),
        (text(RNG.uniform(-1, 1, (5, 9))), "9 columns are .* no usual reading fits"),
        (text(RNG.uniform(-1, 1, (5, 12))), "12 columns are .* no usual reading fits"),
    ],
)
def test_what_has_no_reading_is_said(
    tmp_path: Path, content: str, message: str
) -> None:
    (tmp_path / "p.txt").write_text(content)
    refused(message, read_robot_poses, tmp_path / "p.txt")


def test_a_stated_convention_that_does_not_fit_meets_one_that_does(
    tmp_path: Path,
) -> None:
    file = tmp_path / "p.txt"
    file.write_text(text(rows("wxyz", -3), "{}.png "))
    message = (
        "rotation is before the position; give --c qw,qx,qy,qz,x,y,z:wxyz:inverse$"
    )
    refused(message, read_robot_poses, file, "wxyz:inverse", option="--c")
    file.write_text(text(rows("wxyz", -3)[:, :6]))
    refused("rows have 6 numbers; wxyz takes 7", read_robot_poses, file, "wxyz")


@pytest.mark.parametrize(
    ("convention", "message"),
    [
        ("x,y,z,qw,qx,qy", "rows have 7 numbers, and 6 columns are stated; write ..."),
        ("a,b,c,x,y,z,n", r"columns a, b, c do not define a rotation"),
        ("x,y,z,u,v,w,t:euler", "pose convention .* 'euler' is not one of"),
    ],
)
def test_stated_columns_that_do_not_fit_are_refused(
    tmp_path: Path, convention: str, message: str
) -> None:
    (tmp_path / "p.txt").write_text(text(rows("wxyz")))
    refused(message, read_robot_poses, tmp_path / "p.txt", convention)
