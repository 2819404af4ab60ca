"""An image of the recording's size may be of another camera of the same model."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from evercal.geometry import Camera
from evercal.localization import intrinsics
from evercal.localization.intrinsics import NOT_STATED
from evercal.localization.localizer import Localizer

if TYPE_CHECKING:
    from evercal.mapping.scene_map import MapContents
    from evercal.recordings.frame import Recording
    from evercal.simulation.box_room import BoxRoom


def deviations(
    hall: Recording,
    room: BoxRoom,
    contents: MapContents,
    change: tuple[float, float, float],
) -> list[float]:
    """Squared deviations of located images by a camera with changed intrinsics."""
    localizer = Localizer(contents)
    squares = []
    factor, *shift = change
    for frame in hall.test[1::5]:
        zoomed = frame.camera.zoomed(factor)
        camera = replace(zoomed, cx=zoomed.cx + shift[0], cy=zoomed.cy + shift[1])
        truth = frame.base_from_camera
        assert truth is not None
        answer = localizer.localize(room.render(camera, truth))
        pose = answer.uncertain_pose
        if pose is None or answer.status != "ok":
            continue
        off = pose.pose.translation_m - truth.translation_m
        squares.append(float(off @ np.linalg.solve(pose.covariance[:3, :3], off)))
    return squares


@pytest.mark.parametrize("change", [(1.006, 2.0, -1.5), (0.995, -1.0, 2.0)])
def test_another_camera_of_the_model_is_recognised(
    hall: Recording,
    hall_room: BoxRoom,
    hall_map: MapContents,
    change: tuple[float, float, float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wide = deviations(hall, hall_room, hall_map, change)
    assert len(wide) > 2
    assert max(wide) < 16
    surely = replace(NOT_STATED, other_camera=1e-12)
    monkeypatch.setattr(intrinsics, "NOT_STATED", surely)
    assert max(deviations(hall, hall_room, hall_map, change)) > 16


def test_probability_of_another_camera() -> None:
    camera = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
    precise = np.diag(np.square([5e-4, 0.3, 0.3, 2e-3, 2e-3]))

    def probability(change: list[float], covariance: np.ndarray) -> float:
        return NOT_STATED.doubt(camera, np.array(change), covariance)

    assert probability([0, 0, 0, 0, 0], precise) < 0.01
    assert probability([0.005, 2, 1, 0, 0], precise) > 0.99
    # Nothing was measured.
    assert probability([0.5, 9, 9, 0, 0], 1e6 * precise) == pytest.approx(0.4, abs=0.02)
