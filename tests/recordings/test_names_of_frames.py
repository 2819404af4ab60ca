"""Recordings know the frames that their files name, and are told the others."""

import json
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.recordings import ReadOptions, generic, load_recording, write_image
from evercal.robot.frame_names import FrameNames

CAMERA = '{"width": 32, "height": 24, "fx": 30, "fy": 30, "cx": 15, "cy": 11}'
MESSAGE = """header: {stamp: {sec: %d, nanosec: 0}, frame_id: /base}
child_frame_id: wrist_optical
transform: {translation: {x: 0.1, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0, w: 1}}
"""
ALL = ReadOptions(base_frame="table", gripper_frame="tcp", camera_frame="eye")


def folder(root: Path, name: str, text: str) -> Path:
    """Three images with a camera file and a file of poses."""
    (root / "camera.json").write_text(CAMERA)
    (root / name).write_text(text)
    for i in range(3):
        write_image(root / f"{i}.png", np.full((24, 32, 3), 60 * i, np.uint8))
    return root


def test_a_folder_of_plain_poses_is_told_its_names(tmp_path: Path) -> None:
    rows = "".join(f"{i}.png,{i / 10},0,0,1,0,0,0\n" for i in range(3))
    table = "image,x,y,z,qw,qx,qy,qz\n" + rows
    root = folder(tmp_path, "base_from_gripper.csv", table)
    assert load_recording(root).frames == FrameNames()
    named = load_recording(root, options=ALL)
    assert named.frames == FrameNames("table", "tcp", "eye")
    generic.write(tmp_path / "copy", named)
    assert load_recording(tmp_path / "copy").frames == named.frames
    other = ReadOptions(base_frame="base")  # may be turned against it
    with pytest.raises(
        InputError, match=r"`base_frame` base: .*copy states table; leave"
    ):
        load_recording(tmp_path / "copy", options=other)


@pytest.mark.parametrize("names", [5, ["base"], {"tool": "tcp"}])
def test_names_of_another_kind_are_one_line(tmp_path: Path, names: object) -> None:
    rows = "".join(f"{i}.png,{i / 10},0,0,1,0,0,0\n" for i in range(3))
    table = "image,x,y,z,qw,qx,qy,qz\n" + rows
    root = folder(tmp_path, "base_from_gripper.csv", table)
    generic.write(tmp_path / "copy", load_recording(root))
    file = tmp_path / "copy" / "scene.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "frame_names": names}))
    with pytest.raises(InputError, match=r"scene\.json: "):
        load_recording(tmp_path / "copy")


@pytest.mark.parametrize("owner", ["gripper", "camera"])
def test_messages_name_the_frames_of_their_poses(tmp_path: Path, owner: str) -> None:
    text = "---\n".join(MESSAGE % i for i in range(3))
    root = folder(tmp_path, f"base_from_{owner}.yaml", text)
    stated = {"base": "base", owner: "wrist_optical"}
    assert load_recording(root).frames == FrameNames(**stated)
    camera = "" if owner == "camera" else "eye"
    told = ReadOptions(gripper_frame=stated.get("gripper"), camera_frame=camera)
    names = FrameNames(**{"camera": "eye", **stated})
    assert load_recording(root, options=told).frames == names
    with pytest.raises(InputError, match=r"`base_frame` table: .* states base; leave"):
        load_recording(root, options=ALL)


def test_a_bag_names_base_gripper_and_camera(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="the extra 'bags' is not installed")
    from .formats.bags_of_messages import recorded_bag

    bag = recorded_bag().write(tmp_path)
    names = FrameNames("base_link", "tool0", "camera_optical")
    assert load_recording(bag).frames == names
    renamed = load_recording(bag, options=ReadOptions(camera_frame="eye")).frames
    assert renamed == FrameNames("base_link", "tool0", "eye")
    chosen = ReadOptions(base_frame="world", gripper_frame="camera_optical")
    assert load_recording(bag, options=chosen).frames == FrameNames(
        "world", camera="camera_optical"
    )


def test_a_urdf_names_the_links(tmp_path: Path) -> None:
    joint = (
        '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>'
        '<axis xyz="0 0 1"/><limit lower="-3" upper="3"/></joint>'
    )
    links = "".join(f'<link name="{name}"/>' for name in ("base_link", "arm", "tool0"))
    joints = joint.format("a", "base_link", "arm") + joint.format("b", "arm", "tool0")
    table = "image,a,b\n" + "".join(f"{i}.png,{i / 10},{i / 5}\n" for i in range(3))
    root = folder(tmp_path, "joints.csv", table)
    (root / "arm.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    assert load_recording(root).frames == FrameNames("base_link", "tool0")
    chosen = ReadOptions(gripper_frame="arm", camera_frame="eye")
    frames = load_recording(root, options=chosen).frames
    assert frames == FrameNames("base_link", "arm", "eye")
