"""A scene from a recording: what is said of its frames."""

from dataclasses import replace

import numpy as np
import pytest

from evercal.features.encoder import load_encoder
from evercal.geometry import SE3
from evercal.learning.scene import learn_scene
from evercal.mapping import build
from evercal.mapping.build import MapOptions
from evercal.mapping.pose_check import PoseCheck
from evercal.mapping.scene_map import MapContents
from evercal.recordings import Recording
from evercal.recordings.held_out import split_held_out


def test_a_pose_where_the_map_locates_its_image_is_not_called_wrong(
    hall: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Frames that are set aside are not in the map, and so not accused.
    right, wrong = (split_held_out(hall.train).train[i] for i in (3, 5))
    frames = [*hall.train]
    pose = wrong.base_from_camera
    assert pose is not None
    frames[frames.index(wrong)] = replace(
        wrong, base_from_camera=pose @ SE3.exp([0.05, 0, 0, 0, 0, 0])
    )
    accused = PoseCheck(np.array([3, 5]), np.zeros(0, np.int64))
    monkeypatch.setattr(build, "check_poses", lambda *_: accused)
    contents = MapContents(load_encoder(), 240)
    options = MapOptions(adjust=False)
    recording = replace(hall, train=tuple(frames))
    _, report = learn_scene(recording, contents, options=options)
    assert report.adjusted is not None
    assert report.adjusted.wrong_poses == (wrong.name,)
    assert report.adjusted.untracked == (right.name,)
