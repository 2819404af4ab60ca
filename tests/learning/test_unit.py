"""A recording of unknown unit: its map does not depend on the unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evercal.features.encoder import load_encoder
from evercal.geometry import SE3
from evercal.learning.scene import learn_scene
from evercal.localization.localizer import Localizer
from evercal.localization.tracking import Tracker
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Frame, Recording


def scaled(frames: tuple[Frame, ...], factor: float) -> tuple[Frame, ...]:
    poses = [(frame, frame.base_from_camera) for frame in frames]
    return tuple(
        replace(
            f, base_from_camera=SE3(pose.rotation_wxyz, factor * pose.translation_m)
        )
        for f, pose in poses
        if pose is not None
    )


def answers(arc: Recording, factor: float) -> tuple[np.ndarray, list[str]]:
    """Errors in units of the recording, squared Mahalanobis distances; states of a stream."""
    recording = replace(arc, train=scaled(arc.train, factor), metric=False)
    empty = MapContents(load_encoder(), 120)
    scene, _ = learn_scene(recording, empty, memory="50%")
    assert not scene.metric
    localizer = Localizer(empty.with_scene(scene))
    rows = []
    test = scaled(arc.test[4:8], factor)
    for frame in test:
        pose = localizer.localize(frame.read_image()).uncertain_pose
        truth = frame.base_from_camera
        assert pose is not None
        assert truth is not None
        off = pose.pose.translation_m - truth.translation_m
        rows.append((np.linalg.norm(off) / factor, pose.squared_mahalanobis(truth)))
    tracker = Tracker(localizer)
    return np.array(rows), [tracker.track(test[0].read_image()).state for _ in range(3)]


@pytest.mark.parametrize("factor", [0.001, 50.0])
def test_answers_scale_with_the_unit(
    factor: float, arcs: tuple[Recording, Recording]
) -> None:
    rows, states = answers(arcs[0], 1.0)
    again, others = answers(arcs[0], factor)
    assert rows[:, 0].max() < 0.02
    np.testing.assert_allclose(again, rows, rtol=1e-3)
    assert states[-1] == others[-1] == "tracking"
