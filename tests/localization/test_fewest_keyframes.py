"""The fewest keyframes that locate a recording's other frames well."""

from __future__ import annotations

import numpy as np
import pytest

from evercal.geometry import pose_distance
from evercal.learning.fewest_keyframes import fewest_keyframes
from evercal.localization.localizer import Localizer
from evercal.mapping.built_map import BuiltMap
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Recording


@pytest.fixture(scope="module")
def empty(hall_map: MapContents) -> MapContents:
    return MapContents(hall_map.encoder, hall_map.short_side)


def test_few_keyframes_locate_the_other_frames(
    hall: Recording, hall_built: BuiltMap, empty: MapContents
) -> None:
    selected = fewest_keyframes(empty, hall_built, hall.train)
    assert 1 <= len(selected) < 7
    built = hall_built.take(selected)
    assert built.keyframe_names == tuple(hall_built.keyframe_names[i] for i in selected)
    localizer = Localizer(empty.with_scene(built.scene))
    for frame in hall.train[1::7]:
        estimate = localizer.localize(frame.read_image())
        assert estimate.base_from_camera is not None
        assert frame.base_from_camera is not None
        assert (
            pose_distance(estimate.base_from_camera, frame.base_from_camera)[0] < 0.01
        )


def test_all_keyframes_are_kept_if_fewer_are_worse(
    hall: Recording,
    hall_built: BuiltMap,
    empty: MapContents,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in {
        "SHARES": (0.05, 0.2),
        "MOST_M": 1e-9,
        "PROBE_FRAMES": 8,
    }.items():
        monkeypatch.setattr(f"evercal.learning.fewest_keyframes.{name}", value)
    selected = fewest_keyframes(empty, hall_built, hall.train)
    np.testing.assert_array_equal(selected, np.arange(7))


def test_all_keyframes_are_kept_without_other_frames(
    hall: Recording, hall_built: BuiltMap, empty: MapContents
) -> None:
    keyframes = [
        frame for frame in hall.train if frame.name in hall_built.keyframe_names
    ]
    steps: list[tuple[str, int, int]] = []
    selected = fewest_keyframes(
        empty,
        hall_built,
        keyframes,
        lambda *step: steps.append((step[0], step[1], step[2])),
    )
    np.testing.assert_array_equal(selected, np.arange(7))
    assert steps[-1][1] == steps[-1][2]
