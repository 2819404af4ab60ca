"""All joint values of a robot, without a gripper: two arms on a rail, fingers, a mimic joint."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.recordings import ReadOptions, Recording, load_recording, write_image

JOINT = """<link name="{name}"/><joint name="{name}_joint" type="{kind}"><parent link="{parent}"/>
<child link="{name}"/><origin xyz="0.3 0 0"/><axis xyz="0 0 1"/><limit lower="-3" upper="3"/>{more}
</joint>"""
TREE = (
    ("rail", "base", "prismatic"),
    ("left", "rail", "revolute"),
    ("right", "rail", "revolute"),
    ("finger", "left", "prismatic"),
)
NAMES = ("rail_joint", "left_joint", "right_joint", "finger_joint")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Images, a camera and a URDF."""
    joints = [JOINT.format(name=n, parent=p, kind=k, more="") for n, p, k in TREE]
    thumb = JOINT.format(
        name="thumb",
        parent="left",
        kind="prismatic",
        more='<mimic joint="finger_joint"/>',
    )
    text = f'<robot name="r"><link name="base"/>{"".join(joints)}{thumb}</robot>'
    (tmp_path / "robot.urdf").write_text(text)
    (tmp_path / "camera.txt").write_text("30 0 15.5\n0 30 11.5\n0 0 1\n")
    for i in range(3):
        write_image(tmp_path / f"{i}.png", np.zeros((24, 32, 3), np.uint8))
    return tmp_path


def write_csv(
    folder: Path, columns: Sequence[str], rows: Sequence[Sequence[float]]
) -> None:
    lines = [",".join(columns), *(",".join(map(str, row)) for row in rows)]
    (folder / "joints.csv").write_text("\n".join(lines))


def read(folder: Path, **options: object) -> Recording:
    return load_recording(
        folder,
        options=ReadOptions(whole_robot=True, **options),  # type: ignore[arg-type]
    )


def values(recording: Recording) -> np.ndarray:
    return np.array([frame.joints_rad for frame in recording.train])


def test_all_values_of_joints_are_read(folder: Path) -> None:
    columns = ("right_joint_deg", "torque", "thumb_joint", "rail_joint", "finger_joint")
    rows = [(90, 7, 0.1, 2, 0.1), (-90, 7, 0.2, 2.5, 0.2), (45, 7, 0.3, 3, 0.3)]
    write_csv(folder, columns, rows)
    recording = read(folder)
    assert recording.arm
    assert recording.arm.joints == ("right_joint", "rail_joint", "finger_joint")
    right = np.deg2rad([90, -90, 45])
    expected = np.stack([right, (2, 2.5, 3), (0.1, 0.2, 0.3)], 1)
    np.testing.assert_allclose(values(recording), expected)
    assert recording.notes[:2] == (
        "values of 3 joints of robot.urdf are read",
        "values of no joint that moves by itself: torque, thumb_joint",
    )
    assert recording.frames.base == "base"
    pose = recording.train[0].base_from_gripper
    assert pose
    np.testing.assert_allclose(pose.matrix(), np.eye(4))


def test_without_it_one_end_is_asked_for(folder: Path) -> None:
    write_csv(folder, NAMES, [[0.0] * 4] * 3)
    with pytest.raises(
        InputError, match="has 3 ends; name the link with `gripper_frame`"
    ):
        load_recording(folder)
    with pytest.raises(
        InputError, match="`gripper_frame`: all joints are read; leave it out"
    ):
        read(folder, gripper_frame="left")


def test_json_and_degrees(folder: Path) -> None:
    data = {"joint_names": NAMES[:2], "positions": [[1, 10], [2, 20], [3, 30]]}
    (folder / "joints.json").write_text(json.dumps(data))
    found = values(read(folder, pose_convention="deg"))
    np.testing.assert_allclose(
        found, np.stack([(1, 2, 3), np.deg2rad([10, 20, 30])], 1)
    )
    with pytest.raises(
        InputError, match=r"joint left_joint is at 30\.0, too far for radians"
    ):
        read(folder)


def test_values_are_interpolated_but_not_over_gaps_in_which_a_joint_moves(
    folder: Path,
) -> None:
    (folder / "stamps.csv").write_text(
        "image,stamp_s\n0.png,0.05\n1.png,1.0\n2.png,2.05\n"
    )
    rows = [(0, 0, 0), (0.1, 1, 0.2), (2.0, 2, 0.2), (2.1, 3, 0.2)]
    write_csv(folder, ("stamp_s", "left_joint", "right_joint"), rows)
    recording = read(folder)
    assert [frame.image.name for frame in recording.train] == ["0.png", "2.png"]  # type: ignore[union-attr]
    np.testing.assert_allclose(values(recording), [(0.5, 0.1), (2.5, 0.2)])
    assert recording.untracked == 1


def test_no_joint_in_common_names_both_lists(folder: Path) -> None:
    write_csv(folder, ("a1", "a2"), [[0.0] * 2] * 3)
    message = r"no value is of a joint of .*robot.urdf; given are a1, a2, its joints are rail_j"
    with pytest.raises(InputError, match=message):
        read(folder)


def test_beyond_limits_is_noted(folder: Path) -> None:
    write_csv(folder, ("finger_joint",), [(0,), (1,), (5,)])
    assert "finger_joint goes from 0.00 to 5.00, the URDF allows -3.00 to 3.00" in str(
        read(folder).notes
    )


def test_other_formats_refuse_it(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(
        InputError, match="`whole_robot`: not used by recordings of format nerf"
    ):
        read(tmp_path)
