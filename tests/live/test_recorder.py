"""A recording that grows is readable at any time."""

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.live.recorder import WristRecorder
from evercal.recordings import load_recording
from evercal.recordings.frame import stated_grippers

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
