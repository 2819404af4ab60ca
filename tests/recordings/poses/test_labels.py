"""Image names and times have the same labels in every kind of file."""

import json
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.recordings.poses.joint_tables import read_joints
from evercal.recordings.poses.robot_poses import RobotPoses, read_robot_poses
from evercal.recordings.poses.row_files import LabelledRows, read_rows

from ..checks import refused

NAMES = (
    "image",
    "Image_Name",
    "img",
    "file",
    "filename",
    "file_path",
    "path",
    "name",
    "frame",
)
STAMPS = (
    ("t", 1.0),
    ("time [s]", 1.0),
    ("timestamp", 1.0),
    ("stamp_ms", 1e3),
    ("Time_NS", 1e9),
)
POSE = {"translation_m": [0.5, 0.0, 0.2], "quaternion_wxyz": [1, 0, 0, 0]}


def read_all(
    root: Path, label: str, cells: list[object]
) -> list[RobotPoses | LabelledRows]:
    """Two rows with one label each, in every kind of file."""
    (root / "p.csv").write_text(
        f"x,y,z,qw,qx,qy,qz,{label}\n"
        + "".join(f"0.5,0,0.2,1,0,0,0,{c}\n" for c in cells)
    )
    (root / "p.json").write_text(json.dumps([{**POSE, label: cell} for cell in cells]))
    (root / "r.csv").write_text(
        f"a,{label}\n" + "".join(f"1,{cell}\n" for cell in cells)
    )
    poses = [read_robot_poses(root / name) for name in ("p.csv", "p.json")]
    return [*poses, read_rows(root / "r.csv", "numbers")]


def as_lists(
    root: Path, label: str, cells: list[object]
) -> list[RobotPoses | LabelledRows]:
    """The same in lists beside the poses or joint angles."""
    (root / "p.json").write_text(
        json.dumps({"poses": [POSE] * len(cells), label: cells})
    )
    joints = {"joint_names": ["a"], "positions": [[1.0]] * len(cells), label: cells}
    (root / "joints.json").write_text(json.dumps(joints))
    return [read_robot_poses(root / "p.json"), read_joints(root / "joints.json")]


@pytest.mark.parametrize("label", NAMES)
def test_image_labels_are_recognised(label: str, tmp_path: Path) -> None:
    results = read_all(tmp_path, label, ["b.png", "a.png"])
    results += as_lists(tmp_path, f"{label}s", ["b.png", "a.png"])
    assert [read.names for read in results] == [("b.png", "a.png")] * 5


@pytest.mark.parametrize(("label", "factor"), STAMPS)
def test_time_labels_are_recognised(label: str, factor: float, tmp_path: Path) -> None:
    results = read_all(tmp_path, label, [0.5 * factor, 0.25 * factor])
    name, mark, unit = label.partition("_")
    if "[" not in label:
        results += as_lists(
            tmp_path, f"{name}s{mark}{unit}", [0.5 * factor, 0.25 * factor]
        )
    for read in results:
        assert read.stamps_s is not None
        np.testing.assert_allclose(read.stamps_s, [0.5, 0.25])


def test_column_of_image_files_may_have_any_name(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(
        "picture,x,y,z,qw,qx,qy,qz\nb.png,0.5,0,0.2,1,0,0,0\na.JPG,0.5,0,0.2,1,0,0,0\n"
    )
    assert read_robot_poses(tmp_path / "p.csv").names == ("b.png", "a.JPG")
    entries = [{**POSE, "rgb": f"{i}.png", "depth": f"{i}.tif"} for i in range(2)]
    (tmp_path / "p.json").write_text(json.dumps(entries))
    with pytest.raises(
        InputError, match=r"p\.json: rgb and depth name image files; call the"
    ):
        read_robot_poses(tmp_path / "p.json")
    results = as_lists(tmp_path, "rgb", ["b.png", "a.png"])
    assert [read.names for read in results] == [("b.png", "a.png")] * 2


def test_plainest_of_several_labels_is_used(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text("frame,t,image,name,stamp_ns\n7,1,b.png,home,2e9\n")
    read = read_rows(tmp_path / "r.csv", "numbers")
    assert (read.names, read.columns) == (("b.png",), ())
    assert read.stamps_s is not None
    assert read.stamps_s.tolist() == [2.0]


def test_labels_missing_from_some_rows_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "p.json"
    file.write_text(json.dumps([{**POSE, "image": "a.png"}, POSE]))
    refused(r"p\.json: some poses have 'image', others lack it", read_robot_poses, file)
    file.write_text(json.dumps({"poses": [POSE] * 2, "images": ["a.png"]}))
    refused(r"p\.json: 'images' holds 1 entries for 2 poses", read_robot_poses, file)
