"""Poses as robots, numpy and OpenCV print them: each form gives the same poses."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.conventions import (
    numbers_from_poses,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.poses.robot_poses import read_robot_poses
from evercal.typing import Array

from ..checks import refused

NAMES = tuple(f"{i}.png" for i in range(5))


def arm() -> SE3:
    """Poses of a gripper half a metre from its base."""
    rng = np.random.default_rng(3)
    return SE3(rng.normal(size=(5, 4)), rng.uniform(0.2, 0.8, (5, 3)))


def numbers(name: str) -> Array:
    return numbers_from_poses(arm(), pose_convention(name))


def lines(rows: Array, form: Callable[[int, list[float]], str]) -> str:
    return "\n".join(form(i, row) for i, row in enumerate(rows.tolist()))


def plain(row: list[float]) -> str:
    return " ".join(map(repr, row))


def kuka(row: list[float]) -> str:
    return ", ".join(
        f"{key} {value!r}" for key, value in zip("XYZABC", row, strict=True)
    )


def blocks(matrices: Array) -> str:
    return "\n\n".join(
        "\n".join(plain(row) for row in matrix) for matrix in matrices.tolist()
    )


def printed(matrices: Array) -> str:
    with np.printoptions(precision=17, suppress=False, threshold=10_000):
        return str(matrices)


MATRICES = arm().matrix()
FORMS = {
    "ur list": lines(numbers("ur"), lambda _, row: f"p[{', '.join(map(repr, row))}]"),
    "kuka frame": lines(numbers("kuka"), lambda _, row: f"{{{kuka(row)}}}"),
    "kuka e6pos": "&ACCESS RVP\n"
    + lines(
        numbers("kuka"), lambda _, row: f"E6POS: {{{kuka(row)}, S 2, T 35, E1 0.0}}"
    ),
    "rows of 16": lines(numbers("matrix"), lambda _, row: plain(row)),
    "rows of 12": lines(numbers("matrix")[:, :12], lambda _, row: plain(row)),
    "columns of 16": lines(numbers("franka"), lambda _, row: plain(row)),
    "stamp and 12": lines(
        numbers("matrix")[:, :12], lambda i, row: f"{i}.5 {plain(row)}"
    ),
    "4x4 blocks": blocks(MATRICES),
    "3x4 blocks": blocks(MATRICES[:, :3]),
    "4x4 lines": blocks(MATRICES).replace("\n\n", "\n"),
    "blocks with comments": "# pose\n" + blocks(MATRICES).replace("\n\n", "\n# pose\n"),
    "printed": printed(MATRICES),
    "printed 3x4": printed(MATRICES[:, :3]),
    "printed one by one": "\n".join(printed(matrix) for matrix in MATRICES),
    "lists": "\n".join(str(matrix.tolist()) for matrix in MATRICES),
    "wrapped rows": printed(numbers("matrix")),
    "opencv": "tvec_x,tvec_y,tvec_z,rvec_x,rvec_y,rvec_z\n"
    + lines(numbers("ur"), lambda _, row: ",".join(map(repr, row))),
    "opencv by index": "tvec_0,tvec_1,tvec_2,rvec_0,rvec_1,rvec_2\n"
    + lines(numbers("ur"), lambda _, row: ",".join(map(repr, row))),
    "unit after t": "tx_mm,ty_mm,tz_mm,qx,qy,qz,qw\n"
    + lines(numbers("xyzw:mm"), lambda _, row: ",".join(map(repr, row))),
    "3x4 header": ",".join(f"m{i}{j}" for i in range(3) for j in range(4))
    + "\n"
    + lines(numbers("matrix")[:, :12], lambda _, row: ",".join(map(repr, row))),
}


def assert_arm(read: SE3) -> None:
    assert read.shape == (5,)
    assert np.max(pose_distance(read, arm())) < 1e-12


@pytest.mark.parametrize("form", FORMS)
def test_forms_define_their_poses(tmp_path: Path, form: str) -> None:
    (tmp_path / "p.txt").write_text(FORMS[form])
    assert_arm(read_robot_poses(tmp_path / "p.txt").poses)


@pytest.mark.parametrize("before", ["{}.png ", "{}.png, ", "{}.png = ", "{}.5 "])
@pytest.mark.parametrize("notation", ["ur", "kuka", "matrix"])
def test_notations_may_follow_a_name_or_a_stamp(
    tmp_path: Path, notation: str, before: str
) -> None:
    forms = {
        "ur": lambda row: f"p[{', '.join(map(repr, row))}]",
        "kuka": lambda row: f"{{{kuka(row)}}}",
        "matrix": lambda row: f"[{plain(row)}]",
    }
    text = lines(
        numbers(notation), lambda i, row: before.format(i) + forms[notation](row)
    )
    (tmp_path / "p.txt").write_text(text)
    read = read_robot_poses(tmp_path / "p.txt")
    assert_arm(read.poses)
    if "png" in before:
        assert read.names == NAMES
    else:
        assert read.stamps_s is not None
        assert read.stamps_s[1] == 1.5


@pytest.mark.parametrize(
    ("text", "given", "message"),
    [
        (FORMS["ur list"], "kuka", "are none of kuka"),
        (FORMS["kuka frame"], "ur", "are none of ur"),
        (
            FORMS["ur list"] + "\n" + FORMS["kuka frame"],
            None,
            r"mixes the brackets p\[ and {",
        ),
        (
            "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1",
            None,
            "in both orders; give --c matrix .* or franka",
        ),
        (
            "1 0 0 5 0 2 0 0 0 0 1 0",
            None,
            "what the 12 columns are .* no usual reading fits",
        ),
        (
            blocks(MATRICES.swapaxes(1, 2)),
            None,
            "written column after column; give --c franka",
        ),
        (
            "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 0 0 0",
            None,
            "5 rows of 4 numbers are no",
        ),
        (
            "[[0.1 0.2 0.3 0.4 0.5 0.6]]",
            None,
            "what the 6 columns are .* give --c ur .rotation vector. or rpy",
        ),
    ],
)
def test_ambiguous_forms_are_asked_for(
    tmp_path: Path, text: str, given: str | None, message: str
) -> None:
    (tmp_path / "p.txt").write_text(text)
    refused(message, read_robot_poses, tmp_path / "p.txt", given, option="--c")


def test_conventions_of_matrices_take_12_numbers(tmp_path: Path) -> None:
    (tmp_path / "p.txt").write_text(blocks(MATRICES.swapaxes(1, 2)))
    assert_arm(read_robot_poses(tmp_path / "p.txt", "franka").poses)
    upper = MATRICES[:, :3] * np.array([1, 1, 1, 1000])
    for name, rows in (("matrix:mm", upper), ("franka:mm", upper.swapaxes(1, 2))):
        assert_arm(poses_from_numbers(rows.reshape(5, 12), pose_convention(name)))
        (tmp_path / "p.txt").write_text(
            lines(rows.reshape(5, 12), lambda i, row: f"{i}.png {i}.5 {plain(row)}")
        )
        assert_arm(read_robot_poses(tmp_path / "p.txt", name).poses)
    with pytest.raises(
        InputError, match=r"in columns, or rotations .*give the convention franka"
    ):
        read_robot_poses(tmp_path / "p.txt")


def test_arrays_by_name_are_read(tmp_path: Path) -> None:
    file = tmp_path / "p.npz"
    camera: dict[str, Any] = {"K": np.eye(3), "D": np.zeros((1, 5))}
    for key, poses in (
        ("any", MATRICES),
        ("T", MATRICES[:, :3]),
        ("poses", numbers("franka")),
    ):
        stamps = np.arange(5) * 0.5
        arrays: dict[str, Any] = {
            key: poses,
            "images": np.array(NAMES),
            "stamps_s": stamps,
        }
        np.savez(file, **arrays, **camera)
        read = read_robot_poses(file)
        assert_arm(read.poses)
        assert read.names == NAMES
        assert read.stamps_s is not None
        np.testing.assert_array_equal(read.stamps_s, stamps)
    np.savez(file, one=MATRICES, other=MATRICES, **camera)
    refused(r"one and other of its keys .* call the right one", read_robot_poses, file)
    np.savez(file, robot=MATRICES, gripper=MATRICES, **camera)
    refused(
        r"robot and gripper of its keys .* call the right one", read_robot_poses, file
    )
    np.savez(file, board=MATRICES[::-1], base_from_gripper=MATRICES)
    assert_arm(read_robot_poses(file).poses)
    np.savez(file, **camera)
    refused(r"none of its keys \(K, D\)", read_robot_poses, file)
    file.write_bytes(b"PK\x03\x04 broken")
    refused(r"p\.npz: ", read_robot_poses, file)


def test_json_of_3x4_matrices_and_named_numbers_is_read(tmp_path: Path) -> None:
    file = tmp_path / "p.json"
    file.write_text(json.dumps(MATRICES[:, :3].tolist()))
    assert_arm(read_robot_poses(file).poses)
    file.write_text(json.dumps({"T": MATRICES.tolist(), "names": NAMES}))
    assert read_robot_poses(file).names == NAMES
    vectors = [{"tvec": row[:3], "rvec": row[3:]} for row in numbers("ur").tolist()]
    nested = [
        {
            "image": name,
            "pose": {
                "position": dict(zip("xyz", row[:3], strict=True)),
                "orientation": dict(zip("xyzw", row[3:], strict=True)),
            },
        }
        for name, row in zip(NAMES, numbers("xyzw").tolist(), strict=True)
    ]
    for entries in (vectors, nested):
        file.write_text(json.dumps(entries))
        assert_arm(read_robot_poses(file).poses)
    assert read_robot_poses(file).names == NAMES


def test_numbers_and_convention_are_returned(tmp_path: Path) -> None:
    file = tmp_path / "p.csv"
    rows = lines(
        numbers("kuka"), lambda _, row: ",".join(map(repr, [*row[3:], *row[:3]]))
    )
    file.write_text("A,B,C,X,Y,Z\n" + rows)
    read = read_robot_poses(file, "kuka:inverse")
    assert read.numbers is not None
    assert read.convention is not None
    np.testing.assert_array_equal(read.numbers, numbers("kuka"))
    assert read.convention.name == "kuka:inverse"
    again = poses_from_numbers(read.numbers, read.convention)
    assert np.max(pose_distance(again, read.poses)) < 1e-12
    file.write_text(FORMS["unit after t"])
    read = read_robot_poses(file)
    assert read.numbers is not None
    assert read.convention is not None
    assert_arm(poses_from_numbers(read.numbers, read.convention))
    pose = {"translation_m": [0.5, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}
    (tmp_path / "p.json").write_text(json.dumps([pose]))
    read = read_robot_poses(tmp_path / "p.json")
    assert (read.numbers, read.convention) == (None, None)


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("camera_from", [False, True])
def test_opengl_flips_the_axes_of_the_camera(
    tmp_path: Path, inverse: bool, camera_from: bool
) -> None:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    stated = flip @ MATRICES if camera_from else MATRICES @ flip
    np.save(tmp_path / "p.npy", np.linalg.inv(stated) if inverse else stated)
    name = "matrix:opengl" + (":inverse" if inverse else "")
    assert_arm(
        read_robot_poses(tmp_path / "p.npy", name, camera_from=camera_from).poses
    )
