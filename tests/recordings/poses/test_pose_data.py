"""Poses in YAML, MATLAB files, JSON lines and folders, and tables of robots of many vendors."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.io import savemat

from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.conventions import (
    VENDORS,
    numbers_from_poses,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.poses.pairing import pair_images
from evercal.recordings.poses.robot_poses import read_robot_poses
from evercal.robot.frame_names import FrameNames

from ..checks import refused

NAMES = [f"im{i}.png" for i in range(5)]
_RNG = np.random.default_rng(3)
ARM = SE3(_RNG.normal(size=(5, 4)), _RNG.uniform(0.2, 0.8, (5, 3)))
M = ARM.matrix()
R = M[:, :3, :3]
T = M[:, :3, 3]
INVERSE = ARM.inverse().matrix()


def numbers(name: str) -> list[list[float]]:
    return numbers_from_poses(ARM, pose_convention(name)).tolist()


def assert_arm(path: Path, convention: str | None = None, **options: Any) -> Any:
    read = read_robot_poses(path, convention, **options)
    assert read.poses.shape == (5,)
    assert np.max(pose_distance(read.poses, ARM)) < 1e-5
    return read


def message(
    row: list[float], names: tuple[str, str] = ("position", "orientation")
) -> Any:
    xyz = dict(zip("xyz", row, strict=False))
    xyzw = dict(zip("xyzw", row[3:], strict=True))
    return {names[0]: xyz, names[1]: xyzw}


MESSAGES = [message(row) for row in numbers("xyzw")]
TRANSFORMS = [message(row, ("translation", "rotation")) for row in numbers("xyzw")]
STAMPED = [
    {
        "header": {"stamp": {"sec": i, "nanosec": 500_000_000}, "frame_id": "base"},
        "pose": each,
    }
    for i, each in enumerate(MESSAGES)
]
DATA: dict[str, Any] = {
    "poses": MESSAGES,
    "PoseArray": {"header": {"frame_id": "base"}, "poses": MESSAGES},
    "easy_handeye2": {
        "samples": [{"robot": t, "tracking": TRANSFORMS[0]} for t in TRANSFORMS],
        "parameters": {"calibration_type": "eye_in_hand"},
    },
    "easy_handeye": {
        "samples": {"hand_world_samples": TRANSFORMS, "camera_marker_samples": TRANSFORMS[::-1]}
    },
    "moveit": [
        {"effector_wrt_world": m.ravel().tolist(), "object_wrt_sensor": M[0].ravel().tolist()}
        for m in M
    ],
    "R t": [{"R": m[:3, :3].tolist(), "t": m[:3, 3].tolist()} for m in M],
    "R and t of nine": {"R": R.reshape(5, 9).tolist(), "t": T.tolist()},
    "millimetres": {"R": R.tolist(), "translation_mm": None, "t_mm": (1000 * T).tolist()},
    "columns of OpenCV": [
        {"rvec": [[v] for v in row[3:]], "tvec": [[v] for v in row[:3]]} for row in numbers("ur")
    ],
    "quat_xyzw": [{"xyz": row[:3], "quat_xyzw": row[3:]} for row in numbers("xyzw")],
    "t and q_wxyz": [{"t": row[:3], "q_wxyz": row[3:]} for row in numbers("wxyz")],
    "by name": dict(zip(NAMES, M.tolist(), strict=True)),
    "objects by name": {
        name: {"R": m[:3, :3].tolist(), "t": m[:3, 3].tolist()}
        for name, m in zip(NAMES, M, strict=True)
    },
    "lists by key": {k: [row[i] for row in numbers("wxyz")] for i, k in enumerate(
        ("x", "y", "z", "qw", "qx", "qy", "qz"))},
    "by key and index": {k: {str(j): row[i] for j, row in enumerate(numbers("wxyz"))}
        for i, k in enumerate(("x", "y", "z", "qw", "qx", "qy", "qz"))},
}  # fmt: skip


@pytest.mark.parametrize("kind", DATA)
def test_nested_data_is_read_from_json_and_yaml(tmp_path: Path, kind: str) -> None:
    (tmp_path / "p.json").write_text(json.dumps(DATA[kind]))
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(DATA[kind]))))
    for name in ("p.json", "p.yaml"):
        read = assert_arm(tmp_path / name)
        assert read.names == (tuple(NAMES) if "by name" in kind else None)


def test_messages_of_ros_are_read_with_their_times(tmp_path: Path) -> None:
    tf: list[Any] = [
        {
            "transforms": [
                {"header": s["header"], "child_frame_id": "tool0", "transform": t}
            ]
        }
        for s, t in zip(STAMPED, TRANSFORMS, strict=True)
    ]
    for name, documents in (("p.yaml", STAMPED), ("p.txt", STAMPED), ("tf.yaml", tf)):
        text = (
            "---\n".join(yaml.safe_dump(each, sort_keys=False) for each in documents)
            + "---\n"
        )
        (tmp_path / name).write_text(text)
        read = assert_arm(tmp_path / name)
        np.testing.assert_allclose(read.stamps_s, np.arange(5) + 0.5)
        assert read.frames == FrameNames("base", "tool0" if name == "tf.yaml" else "")
    tf[1]["transforms"][0]["child_frame_id"] = "camera"
    (tmp_path / "p.yaml").write_text(yaml.safe_dump_all(tf))
    refused("holds poses of camera and tool0", read_robot_poses, tmp_path / "p.yaml")
    other = {**STAMPED[0], "header": {**STAMPED[0]["header"], "frame_id": "base_link"}}
    (tmp_path / "p.yaml").write_text(yaml.safe_dump_all([other, *STAMPED[1:]]))
    refused("poses of base and base_link", read_robot_poses, tmp_path / "p.yaml")


def test_the_poses_of_the_camera_are_read_beside_those_of_the_robot(
    tmp_path: Path,
) -> None:
    file = tmp_path / "p.npz"
    board = ARM.inverse()
    parts: dict[str, Any] = {"R_gripper2base": R, "t_gripper2base": T[:, :, None]}
    matrices = board.matrix()
    parts |= {"R_target2cam": matrices[:, :3, :3], "t_target2cam": matrices[:, :3, 3:]}
    np.savez(file, **parts)
    assert_arm(file)
    camera = read_robot_poses(file, robot=False)
    assert np.max(pose_distance(camera.poses, board)) < 1e-9
    np.savez(file, R_base2gripper=INVERSE[:, :3, :3], t_base2gripper=INVERSE[:, :3, 3])
    refused("R_base2gripper is the inverse .* matrix:inverse", read_robot_poses, file)
    assert_arm(file, "matrix:inverse")
    np.savez(file, R_a=R, t_a=T, R_b=R, t_b=T)
    refused("R_a with t_a and R_b with t_b of its keys", read_robot_poses, file)
    vectors = np.array(numbers("ur"))
    np.savez(
        file, rvecs=vectors[:, 3:, None], tvecs=vectors[:, :3, None], mtx=np.eye(3)
    )
    assert_arm(file, robot=False)


def test_samples_of_a_fixed_camera_are_inverse_in_easy_handeye(tmp_path: Path) -> None:
    rows = numbers_from_poses(ARM.inverse(), pose_convention("xyzw")).tolist()
    samples = [{"robot": message(row, ("translation", "rotation"))} for row in rows]
    for stated in ({"calibration_type": "eye_on_base"}, {"eye_on_hand": False}):
        data = {"parameters": stated, "samples": samples}
        (tmp_path / "p.yaml").write_text(yaml.safe_dump(data))
        refused(
            "gripper_from_base .* wxyz:inverse", read_robot_poses, tmp_path / "p.yaml"
        )
        assert_arm(tmp_path / "p.yaml", "wxyz:inverse")


MATLAB: dict[str, dict[str, Any]] = {
    "4x4xn": {"T": np.moveaxis(M, 0, -1)},
    "nx4x4": {"T": M},
    "3x3xn and 3xn": {"R": np.moveaxis(R, 0, -1), "t": T.T},
    "nx3x3 and nx3x1": {"R": R, "t": T[:, :, None]},
    "more": {"poses": M, "note": "text", "K": np.eye(3)},
}


@pytest.mark.parametrize("kind", MATLAB)
def test_matlab_files_are_read(tmp_path: Path, kind: str) -> None:
    """Files of scipy 1.17.1, which writes those of MATLAB 5."""
    savemat(tmp_path / "p.mat", MATLAB[kind], do_compression=True)
    assert_arm(tmp_path / "p.mat")


def test_four_matrices_may_lie_along_either_axis(tmp_path: Path) -> None:
    for matrices in (M[:4], np.moveaxis(M[:4], 0, -1)):
        savemat(tmp_path / "p.mat", {"T": matrices})
        read = read_robot_poses(tmp_path / "p.mat")
        assert np.max(pose_distance(read.poses, ARM[:4])) < 1e-9


def test_broken_data_is_refused(tmp_path: Path) -> None:
    for name, content, text in (
        ("a.mat", b"hello", "no readable arrays"),
        ("a.jsonl", b'{"x": 1}\n{oops\n', "Expecting"),
        ("a.yaml", b"a: [1, 2\n", "not valid YAML"),
        ("b.yaml", b"a: &x 1\nb: *x\n", "references"),
        ("a.npz", b"PK", "a.npz: "),
    ):
        (tmp_path / name).write_bytes(content)
        refused(text, read_robot_poses, tmp_path / name)
    savemat(tmp_path / "s.mat", {"s": {"R": 1.0}})
    refused("none of its keys", read_robot_poses, tmp_path / "s.mat")


def test_json_lines_are_read(tmp_path: Path) -> None:
    rows = [{"image": n, "matrix": m} for n, m in zip(NAMES, M.tolist(), strict=True)]
    (tmp_path / "p.jsonl").write_text("\n".join(map(json.dumps, rows)))
    assert assert_arm(tmp_path / "p.jsonl").names == tuple(NAMES)


def visp(folder: Path, name: str, vectors: list[list[float]]) -> None:
    """The layout of vpPoseVector::saveYAML in ViSP's sample data."""
    for i, row in enumerate(vectors):
        lines = "".join(f"  - [{value!r}]\n" for value in row)
        text = f"rows: 6\ncols: 1\ndata: \n{lines}"
        (folder / f"franka_pose_{name}_{i + 1}.yaml").write_text(text)


def test_a_folder_of_one_file_for_each_pose_is_read(tmp_path: Path) -> None:
    for i, matrix in enumerate(M):
        np.savetxt(tmp_path / f"{i + 7}.txt", matrix)
    assert assert_arm(tmp_path).names == ("7", "8", "9", "10", "11")
    np.save(tmp_path / "8.npy", M)
    np.save(tmp_path / "9.npy", M)
    refused("N.txt and N.npy; give a folder", read_robot_poses, tmp_path)
    for i in range(7, 12):
        (tmp_path / f"{i}.txt").unlink()
    refused("8.npy: holds several poses", read_robot_poses, tmp_path)
    (tmp_path / "empty").mkdir()
    refused("folder holds no file of .csv", read_robot_poses, tmp_path / "empty")


def test_the_poses_of_visp_are_read_by_role(tmp_path: Path) -> None:
    visp(tmp_path, "fPe", numbers("ur"))
    visp(tmp_path, "cPo", numbers("ur")[::-1])
    read = assert_arm(tmp_path)
    camera = read_robot_poses(tmp_path, robot=False)
    assert np.max(pose_distance(camera.poses, ARM[::-1])) < 1e-9
    images = [Path(f"image-{i:03d}.png") for i in range(1, 6)]
    poses, _, notes = pair_images(images, read, None, tmp_path)
    assert (
        np.max(pose_distance(SE3.stack([p for p in poses if p is not None]), ARM))
        < 1e-9
    )
    assert "paired by numbers: franka_pose_fPe_1 with image-001.png" in notes[0]
    images[0] = Path("image-000.png")
    refused("names no image", pair_images, images, read, None, tmp_path)


# Numbers of one pose by robodk 6.0.2: robomath's Pose_2_Staubli, Pose_2_Fanuc and so on, of
# KUKA_2_Pose([400, 31, 553, 20, -35, 70]).
ROBODK = {
    "kuka": (20, -35, 70),
    "staubli": (73.57050306394343, 7.87717194006113, 39.00567923406104),
    "motoman": (70, -35, 20),
    "yaskawa": (70, -35, 20),
    "fanuc": (70, -35, 20),
    "techman": (70, -35, 20),
    "nachi": (20, -35, 70),
    "comau": (-81.79197702162966, 73.72985782780218, 126.69146391665883),
    "abb": (
        0.7394199622861923,
        0.5814926354071172,
        -0.1475908708920294,
        0.30551819777110445,
    ),
    "ur:mm": (1.2758617739125704, -0.3238313589608379, 0.6703420921193699),
}


@pytest.mark.parametrize("name", ROBODK)
def test_conventions_agree_with_robodk(name: str) -> None:
    expected = poses_from_numbers(
        [400, 31, 553, 20, -35, 70], pose_convention("moving_zyx:mm:deg")
    )
    read = poses_from_numbers([400, 31, 553, *ROBODK[name]], pose_convention(name))
    assert max(pose_distance(read, expected)) < 1e-9


def test_vendors_state_millimetres_and_degrees() -> None:
    for vendor in VENDORS.keys() - {"universal_robots"}:
        convention = pose_convention(f"{vendor}:inverse")
        assert (convention.metres_per_unit, convention.degrees) == (0.001, True)
