"""Landmarks that stand where they stood, beside others that moved against the camera."""

from __future__ import annotations

import numpy as np
import pytest

from evercal.geometry import SE3
from evercal.localization.localizer import Localizer
from evercal.localization.unmoved import unmoved
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Recording
from evercal.simulation.box_room import BoxRoom

PUSHES = {
    "sideways": [0.08, 0, 0, 0, 0, 0],
    "up": [0, -0.06, 0.02, 0, 0, 0],
    "back": [0.02, 0.02, -0.25, 0, 0, 0],
    "turned": [0.02, 0, 0, 0, 0.04, 0],
}


@pytest.fixture(scope="module")
def localizer(hall_map: MapContents) -> Localizer:
    return Localizer(hall_map)


def share(
    localizer: Localizer, image: np.ndarray, hall: Recording, then: SE3, now: SE3
) -> float:
    scene = localizer.contents.scenes[0]
    return unmoved(localizer, image, hall.train[0].camera, scene, then, now)


@pytest.mark.parametrize("push", PUSHES)
@pytest.mark.parametrize("stays", [0.25, 0.5])
def test_a_part_that_stays_is_recognised(
    localizer: Localizer, hall: Recording, hall_room: BoxRoom, push: str, stays: float
) -> None:
    """The image is composed of the view before and the view after the push."""
    frame = hall.test[5]
    then = frame.base_from_camera
    assert then is not None
    now = then @ SE3.exp(PUSHES[push])
    image = hall_room.render(frame.camera, now)
    column = int(stays * image.shape[1])
    image[:, :column] = frame.read_image()[:, :column]
    assert share(localizer, image, hall, then, now) > 0.05


@pytest.mark.parametrize("push", PUSHES)
def test_after_a_motion_of_the_camera_nothing_stays(
    localizer: Localizer, hall: Recording, hall_room: BoxRoom, push: str
) -> None:
    for frame in hall.test[2:18:5]:
        then = frame.base_from_camera
        assert then is not None
        now = then @ SE3.exp(PUSHES[push])
        image = hall_room.render(frame.camera, now)
        assert share(localizer, image, hall, then, now) == 0.0
