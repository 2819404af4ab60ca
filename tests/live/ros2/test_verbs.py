"""`record`, `track --publish` and `export --publish` in graphs of several processes."""

import io
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from scipy.spatial.transform import Rotation

from evercal import cli
from evercal.calibration.calibration import Calibration
from evercal.geometry import SE3, UncertainPose
from evercal.live.ros2.graph import Graph
from evercal.live.ros2.publishing import POSE, PosePublisher, about_fixed_axes
from evercal.live.sources import open_robot
from evercal.mapping.store import MapStore
from evercal.recordings import load_recording
from evercal.recordings.formats.bags.file import TF
from evercal.recordings.images import write_jpeg
from evercal.robot.frame_names import FrameNames

from .graphs import driver, environment, tell

RAW = "ros2:/camera/image_raw"


@pytest.fixture(autouse=True)
def on_loopback(monkeypatch):
    for name, value in environment().items():
        monkeypatch.setenv(name, value)


def test_a_sample_wherever_the_arm_stands_anew(tmp_path):
    out = tmp_path / "recording"
    words = ["record", RAW, str(out), "--most", "3", "--json"]
    codes = []
    with (
        driver("arm") as arm,
        driver("camera", "raw", "reliable", "64x48") as camera,
    ):
        recorder = threading.Thread(target=lambda: codes.append(cli.main(words)))
        recorder.start()
        for number in range(3):
            end = time.monotonic() + 20
            while not (out / f"images/{number:04d}.jpg").exists():
                assert time.monotonic() < end
                time.sleep(0.02)
            tell(camera, 60 * (number + 1))
            tell(arm, 0.3 * (number + 1))
        recorder.join(20)
    assert codes == [1]  # three samples are too few to learn
    recording = load_recording(out)
    assert recording.frames == FrameNames("base_link", "tool0", "wrist_optical")
    assert len(recording.train) == 3
    assert recording.train[0].camera.fx == 64
    for number, frame in enumerate(recording.train):
        assert frame.base_from_gripper is not None
        turn = frame.base_from_gripper.rotation.as_rotvec()
        np.testing.assert_allclose(turn, (0, 0, 0.3 * number), atol=1e-7)
        assert abs(int(frame.read_image()[-1, -1, 0]) - 60 * number) < 3


def test_a_sample_by_key_with_poses_of_ones_own_driver(tmp_path, monkeypatch):
    poses = tmp_path / "poses.csv"
    poses.write_text("x,y,z,qw,qx,qy,qz\n0.1,0.2,0.3,1,0,0,0\n")
    out = tmp_path / "recording"
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n\n"))
    words = ["record", RAW, str(out), "--poses", str(poses), "--key"]
    with driver("camera", "compressed", "reliable", "64x48"):
        words[1] = f"{RAW}/compressed"
        assert cli.main([*words, "--base-frame", "base"]) == 1
    recording = load_recording(out)
    assert len(recording.train) == 2
    assert recording.frames == FrameNames("base", "", "wrist_optical")


def test_a_recording_needs_poses(tmp_path, capsys):
    assert cli.main(["record", "0", str(tmp_path)]) == 2
    assert "no --poses given" in capsys.readouterr().err


def test_covariances_about_fixed_axes():
    rng = np.random.default_rng(4)
    root = 1e-3 * rng.normal(size=(6, 6))
    pose = UncertainPose(SE3.exp(rng.normal(size=6)), root @ root.T)
    errors = rng.multivariate_normal(np.zeros(6), pose.covariance, 100_000)
    own = pose.pose.rotation
    wrong = own * Rotation.from_rotvec(errors[:, 3:])
    fixed = (wrong * own.inv()).as_rotvec()  # about the axes of the parent
    sampled = np.cov(np.hstack([errors[:, :3], fixed]).T)
    scale = np.abs(sampled).max()
    np.testing.assert_allclose(about_fixed_axes(pose), sampled, atol=0.02 * scale)


def test_a_late_program_receives_a_published_calibration(tmp_path):
    pose = SE3.exp([0.5, -0.2, 0.8, 0.3, 2.0, -0.4])
    root = 1e-3 * np.random.default_rng(1).normal(size=(6, 6))
    uncertain = UncertainPose(pose, root @ root.T)
    publisher = PosePublisher("base_link", "tripod-optical", static=True)
    publisher.publish(uncertain, 12.5)
    graph = Graph()
    stated = graph.subscribe("/evercal/tripod_optical/pose", POSE, True, latched=True)
    robot = open_robot("ros2:", FrameNames("base_link", "tripod-optical"))
    heard = robot.base_from_gripper()
    np.testing.assert_allclose(heard.matrix(), pose.matrix(), atol=1e-12)
    message = stated.take()[0].content
    assert message.header.frame_id == "base_link"
    assert message.header.stamp.nanosec == 5 * 10**8
    covariance = message.pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(covariance, about_fixed_axes(uncertain))
    del publisher


def test_tracked_poses_are_published(hall_map, hall, tmp_path):
    store = tmp_path / "hall.evercal"
    MapStore.create(store).commit(hall_map.scenes[0], {})
    write_jpeg(tmp_path / "images/0000.jpg", hall.test[3].read_image(), 95)
    graph = Graph()
    poses = graph.subscribe("/evercal/camera/pose", POSE, True, depth=10)
    moved = graph.subscribe("/tf", TF[0], True, depth=10)
    words = ["track", store, tmp_path / "images", "--publish", "base", "camera"]
    assert cli.main([*map(str, words)]) == 0
    stated = poses.take()[0].content
    transform = moved.take()[0].content.transforms[0]
    assert (stated.header.frame_id, transform.child_frame_id) == ("base", "camera")
    true = hall.test[3].base_from_camera.translation_m
    place = stated.pose.pose.position
    assert np.abs(np.array([place.x, place.y, place.z]) - true).max() < 0.02
    assert stated.pose.covariance[0] > 0


def test_the_studio_samples_a_topic_at_a_pose_of_tf(tmp_path):
    from evercal.cli.studio import Studio
    from evercal.service.studio.devices import Connection

    with driver("arm"), driver("camera", "raw", "reliable", "64x48"):
        words = ["--camera", RAW, "--poses", "ros2:", "--out", str(tmp_path / "out")]
        devices = cli.parsed(["studio", *words])._real()
        assert isinstance(cli.parsed(["studio", *words]), Studio)
        assert devices.intrinsics.fx == 64
        connection = Connection(devices)
        image, pose = connection.sample()
        names = FrameNames("base_link", "tool0", "wrist_optical")
        assert connection.frames("wrist") == names
        assert image.shape == (48, 64, 3)
        np.testing.assert_allclose(pose.translation_m, (0.5, 0, 0.6), atol=1e-9)


def test_a_calibration_is_published_until_the_command_ends(tmp_path):
    pose = UncertainPose(SE3.exp([0.5, -0.2, 0.8, 0.3, 2.0, -0.4]), 1e-6 * np.eye(6))
    names = FrameNames("base_link", "", "tripod_optical")
    file = tmp_path / "tripod.json"
    Calibration("eye_to_hand", pose.pose, pose.covariance, frames=names).write(file)
    command = [sys.executable, "-m", "evercal", "export", str(file), "--publish"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert "published on /tf_static" in process.stdout.readline()
        robot = open_robot("ros2:", FrameNames("base_link", "tripod_optical"))
        heard = robot.base_from_gripper()
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    np.testing.assert_allclose(heard.matrix(), pose.pose.matrix(), atol=1e-12)
