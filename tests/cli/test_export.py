"""`evercal export`: formats, frame names, driver frames and error messages."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from evercal.calibration.calibration import (
    Calibration,
    ImageUse,
    JointOffset,
    read_calibration,
)
from evercal.calibration.export.formats import FORMATS
from evercal.calibration.export.request import (
    read_link_from_optical,
    standard_link_from_optical,
)
from evercal.cli.args import next_words
from evercal.errors import with_options
from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings.poses.robot_poses import read_robot_poses
from evercal.robot.frame_names import FrameNames
from evercal.robot.mount import MountName

POSE = SE3.exp([0.9, -0.1, 0.5, -1.5, 0.6, 0.4])


@pytest.fixture
def make(tmp_path) -> Any:
    def write(mount: MountName = "eye_to_hand", child: str = "camera") -> Path:
        camera = Camera(640, 480, 600, 601, 320, 240)
        images = (ImageUse("1.png", True),)
        calibration = Calibration(
            mount,
            POSE,
            1e-8 * np.eye(6),
            FrameNames("base", "gripper", child),
            camera,
            images,
            verdict="good",
        )
        calibration.write(tmp_path / "calibration.json")
        return tmp_path / "calibration.json"

    return write


@pytest.fixture
def gripper(tmp_path) -> Path:
    lines = [f"{i}.png,{0.5 + i / 10},0.1,0.2,1,0,0,0" for i in range(3)]
    file = tmp_path / "gripper.csv"
    file.write_text("\n".join(["image,x,y,z,qw,qx,qy,qz", *lines]))
    return file


def test_the_list_names_every_format(run):
    lines = run("export --format list").out.splitlines()
    assert [line.split()[0] for line in lines] == [*FORMATS, "next:"]
    listed = run.json("export --format list")["formats"]
    assert listed == {k: with_options(row.description) for k, row in FORMATS.items()}


@pytest.mark.parametrize("name", ["easy_handeye2", "urdf", "opencv", "kuka"])
def test_printed_and_written_text_are_equal(run, make, tmp_path, name):
    file = make()
    printed = run("export", file, "--format", name)
    assert (printed.code, printed.err) == (0, [])
    out = tmp_path / "evercal.txt"
    written = run("export", file, "--format", name.replace("_", "-"), "--out", out)
    assert written.code == 0
    assert out.read_text() == printed.out
    wrote, meaning, verdict, following = written.out.splitlines()
    assert wrote == f"wrote {out}"
    assert meaning.strip() == "pose of camera in base: takes points from camera to base"
    assert verdict.strip() == "good"
    assert following.startswith("next: evercal check MAP IMAGE --reference")
    record = run.json("export", file, "--format", name)
    assert record["text"] == printed.out
    assert record["translation_m"] == POSE.translation_m.tolist()


def test_unknown_frames_are_asked_for_and_named_by_the_next_step(run, make):
    file = make()
    known = replace(read_calibration(file), verifications=({},))
    words = ("export", file, "--format", "easy_handeye2")
    assert (*next_words(known, file),) == words
    unknown = replace(known, frames=FrameNames("base_link"))
    unknown.write(file)
    refused = run(*words)
    assert (refused.code, refused.out) == (2, "")
    assert refused.err == [
        "error: the name of the camera's frame is unknown: give --child, such as"
        " camera_color_optical_frame; the name of the gripper frame is unknown: give"
        " --robot-frame, such as tool0 or flange"
    ]
    options = ("--child", "CAMERA", "--robot-frame", "GRIPPER")
    assert (*next_words(unknown, file),) == words + options
    assert run(*words, *options).code == 0


def test_binary_files_and_folders_are_not_printed(run, make, tmp_path):
    file = make()
    for name in ("npy", "colmap"):
        refused = run("export", file, "--format", name)
        assert (refused.code, refused.out) == (2, "")
        assert "cannot be printed; give --out" in refused.err[0]
    assert run("export", file, "--format npy --out", tmp_path / "m.npy").code == 0
    np.testing.assert_allclose(np.load(tmp_path / "m.npy"), POSE.matrix())
    written = run("export", file, "--format colmap --out", tmp_path / "m", "--json")
    names = {Path(path).name for path in written.json["files"]}
    assert names == {path.name for path in (tmp_path / "m").iterdir()}
    assert names == {"cameras.txt", "images.txt", "points3D.txt"}
    assert "already there" in run(
        "export", file, "--format colmap --out", tmp_path / "m"
    ).err[0]  # fmt: skip


def test_frames_are_renamed_and_the_file_gives_the_name(run, make, tmp_path):
    words = ("--format easy_handeye2 --parent panda_link0 --child cam_link",)
    out = tmp_path / "cell_left.calib"
    run("export", make(), *words, "--robot-frame panda_hand --out", out)
    parameters = yaml.safe_load(out.read_text())["parameters"]
    assert parameters["name"] == "cell_left"
    frames = ("robot_base_frame", "robot_effector_frame", "tracking_base_frame")
    assert [parameters[key] for key in frames] == [
        "panda_link0",
        "panda_hand",
        "cam_link",
    ]


def test_the_driver_root_frame_is_exported(run, make, tmp_path):
    file = make(child="camera_color_optical_frame")
    tf = tmp_path / "tf.yaml"
    words = ("export", file, "--format transform_stamped")
    note = "note: most camera drivers publish camera_color_optical_frame themselves"
    assert note in run(*words).err[0]
    for options, link_from_optical in (
        (["--via-optical"], standard_link_from_optical()),
        (["--via-offset", "1", "2", "3"], standard_link_from_optical((1.0, 2.0, 3.0))),
        (["--via-transform", tf], SE3.exp([0.1, 0.2, 0.3, 0.5, 0.0, 0.2])),
    ):
        link = replace(read_calibration(file), parent_from_child=link_from_optical)
        link.export("transform_stamped", tf, parent="camera_link")
        ran = run(*words, "--via camera_link", *options)
        assert (ran.code, ran.err) == (0, [])
        (tmp_path / "out.yaml").write_text(ran.out)
        link = read_link_from_optical(tmp_path / "out.yaml", "base", "camera_link")
        assert np.max(pose_distance(link @ link_from_optical, POSE)) < 1e-9


def test_a_camera_on_the_arm_gets_a_pose_per_robot_pose(run, make, gripper, tmp_path):
    words = (
        "export",
        make("eye_in_hand"),
        "--format tum --out",
        tmp_path / "c.tum",
    )
    assert run(*words, "--robot-poses", gripper).code == 0
    camera = read_robot_poses(tmp_path / "c.tum").poses
    expected = read_robot_poses(gripper).poses @ POSE
    assert np.max(pose_distance(camera, expected)) < 1e-12
    gripper.write_text("0.png 500 100 200 0 0 0 1\n1.png 600 100 200 0 0 0 1")
    assert run(*words, "--robot-poses", gripper, "--convention xyzw:mm").code == 0
    assert len(read_robot_poses(tmp_path / "c.tum")) == 2
    refused = run(*words, "--robot-poses", gripper, "--convention xyzw")
    assert "look like millimetres; give --convention xyzw:mm" in refused.err[0]


def test_the_arm_is_exported_with_the_offsets_of_its_joints(run, make, tmp_path):
    file = make("eye_in_hand")
    refused = run(
        "export", file, "--format corrected_urdf --urdf", tmp_path / "arm.urdf"
    )
    assert "record joints.csv and a URDF, not gripper poses" in refused.err[0]
    joints = (JointOffset("lift", 0.02, 0.001),)
    covariance = np.array([[1e-6]])
    replace(read_calibration(file), joints=joints, joint_covariance=covariance).write(
        file
    )
    (tmp_path / "arm.urdf").write_text(
        '<robot name="r"><link name="a"/><link name="b"/><joint name="lift" type="continuous">'
        '<parent link="a"/><child link="b"/><origin rpy="0 0 0"/><axis xyz="1 0 0"/></joint>'
        "</robot>"
    )
    (tmp_path / "so101.json").write_text('{"lift": {"id": 1, "homing_offset": 5}}')
    of_lerobot = (
        "--lerobot-calibration",
        tmp_path / "so101.json",
        "--lerobot-motors feetech",
    )
    for name, words, expected in (
        ("joint-offsets", (), '"offset_rad": 0.02,'),
        (
            "corrected-urdf",
            ("--urdf", tmp_path / "arm.urdf"),
            '<origin rpy="0.02 0.0 0.0"/>',
        ),
        ("lerobot", of_lerobot, '"homing_offset": -8'),
    ):
        ran = run("export", file, "--format", name, *words, "--out", tmp_path / "out")
        assert (ran.code, ran.err) == (0, [])
        assert expected in (tmp_path / "out").read_text()
