"""A recording that grows is readable at any time."""

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.live.recorder import WristRecorder
from evercal.recordings import load_recording
from evercal.recordings.frame import stated_grippers
from evercal.robot.frame_names import FrameNames

CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)


def test_samples_are_added_removed_and_continued(tmp_path):
    rng = np.random.default_rng(0)
    poses = SE3.exp(rng.normal(scale=0.5, size=(4, 6)))
    image = np.full((24, 32, 3), 90, np.uint8)
    recorder = WristRecorder(tmp_path / "wrist", CAMERA)
    for pose in poses[:3]:
        recorder.add(image, pose)
    recorder.remove("0001.jpg")
    again = WristRecorder(tmp_path / "wrist", CAMERA)
    assert again.add(image, poses[3]).name == "0003.jpg"
    read = load_recording(tmp_path / "wrist").train
    grippers = stated_grippers(read)
    for k, i in enumerate((0, 2, 3)):
        assert again.frames[k].name == read[k].name == f"{i:04d}.jpg"
        assert max(pose_distance(grippers[k], poses[i])) < 1e-7
        assert abs(int(read[k].read_image()[5, 5, 0]) - 90) < 3
    assert len(again.frames) == len(read) == 3
    assert read[0].camera == CAMERA


def test_mistakes_are_refused(tmp_path):
    recorder = WristRecorder(tmp_path, CAMERA)
    with pytest.raises(InputError, match="32x24"):
        recorder.add(np.zeros((48, 64, 3), np.uint8), SE3.identity())
    with pytest.raises(InputError, match=r"no\.jpg"):
        recorder.remove("no.jpg")
    recorder.add(np.zeros((24, 32, 3), np.uint8), SE3.from_translation((0.3, 0, 0.3)))
    with pytest.raises(InputError, match="other intrinsics"):
        WristRecorder(tmp_path, Camera(32, 24, 40.0, 40.0, 15.5, 11.5))


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("left.jpg", "img_7.jpg"), "0000.jpg"),
        (("0003.png", "x.jpg"), "0004.jpg"),
        (("²³.jpg", "1759312345678.jpg", "-5.jpg"), "0000.jpg"),
        (("0011.jpg", "notes.txt", "0012.xml"), "0013.jpg"),
    ],
)
def test_a_recording_whose_images_are_not_numbered_is_continued(
    tmp_path, names, expected
):
    image = np.full((24, 32, 3), 90, np.uint8)
    poses = SE3.exp(np.random.default_rng(0).normal(scale=0.5, size=(len(names), 6)))
    recorder = WristRecorder(tmp_path, CAMERA)
    for pose in poses:
        recorder.add(image, pose)
    table = (tmp_path / "base_from_gripper.csv").read_text()
    for i, name in enumerate(names):
        (tmp_path / "images" / f"{i:04d}.jpg").rename(tmp_path / "images" / name)
        table = table.replace(f"{i:04d}.jpg", name)
    rows = [row for row in table.splitlines() if not row.startswith(("notes", "0012"))]
    (tmp_path / "base_from_gripper.csv").write_text("\n".join(rows) + "\n")
    again = WristRecorder(tmp_path, CAMERA)
    assert again.add(image, poses[0]).name == expected
    assert len(load_recording(tmp_path).train) == len(rows)


def test_images_that_lie_elsewhere_are_refused(tmp_path):
    image = np.full((24, 32, 3), 90, np.uint8)
    WristRecorder(tmp_path / "a", CAMERA).add(image, SE3.identity())
    (tmp_path / "b").mkdir()
    for name in ("camera.json", "base_from_gripper.csv"):
        (tmp_path / "b" / name).write_bytes((tmp_path / "a" / name).read_bytes())
    (tmp_path / "b" / "images").symlink_to(tmp_path / "a" / "images")
    with pytest.raises(InputError, match=r"images: is a link; use a new folder"):
        WristRecorder(tmp_path / "b", CAMERA)


def test_a_recording_of_other_frames_is_refused(tmp_path):
    names = FrameNames("base_link", "tool0", "wrist_optical")
    image = np.zeros((24, 32, 3), np.uint8)
    WristRecorder(tmp_path / "wrist", CAMERA, names).add(image, SE3.identity())
    assert WristRecorder(tmp_path / "wrist", CAMERA).names == names
    with pytest.raises(InputError, match="was recorded with other frames"):
        WristRecorder(tmp_path / "wrist", CAMERA, FrameNames(camera="tripod"))
    with pytest.raises(InputError, match=r"it has some; give .*wrist"):
        load_recording(tmp_path)
