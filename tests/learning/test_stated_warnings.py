"""What a map knows to be wrong about its recording is said, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evercal.features.encoder import load_encoder
from evercal.geometry import SE3
from evercal.learning.stated_warnings import stated_warnings
from evercal.mapping.build import build_map
from evercal.mapping.built_map import Adjusted, BuiltMap
from evercal.recordings import Recording


def warnings(adjusted: Adjusted) -> list[str]:
    return list(stated_warnings(adjusted, camera_stated=True))


def test_nothing_is_said_of_an_exact_recording(hall_built: BuiltMap) -> None:
    assert warnings(hall_built.adjusted) == []
    assert 0.5 < (hall_built.adjusted.depth_m or 0) < 5


@pytest.mark.parametrize("tangent", [(0, 0, 0.03, 0, 0, 0), (0, 0, 0, 0, 0, 0.05)])
def test_an_offset_of_the_mount_is_measured_and_said(
    hall: Recording, tangent: tuple[float, ...]
) -> None:
    offset = SE3.exp(np.array(tangent))
    frames = []
    for frame in hall.train:
        assert frame.base_from_camera is not None
        frames.append(replace(frame, base_from_camera=frame.base_from_camera @ offset))
    adjusted = build_map("hall", frames, load_encoder()).adjusted
    shift = np.array(adjusted.common_translation_mm) / 1000
    turn = np.deg2rad(adjusted.common_rotation_deg)
    np.testing.assert_allclose(shift, -np.array(tangent[:3]), atol=3e-3)
    np.testing.assert_allclose(turn, -np.array(tangent[3:]), atol=2e-3)
    (warning,) = warnings(adjusted)
    assert warning.startswith("the camera is ")
    # A gripper's poses say nothing of the camera.
    assert list(stated_warnings(adjusted, camera_stated=False)) == []


def test_an_uncertain_or_small_offset_is_not_said() -> None:
    far = Adjusted(common_translation_mm=(0, 0, 30.0), common_sigma_mm=0.3)
    assert len(warnings(far)) == 1
    assert warnings(replace(far, common_sigma_mm=7.0)) == []
    assert warnings(replace(far, common_translation_mm=(0, 0, 2.0))) == []


@pytest.mark.parametrize("depth_m", [59.0, 1500.0, 0.002])
def test_another_unit_is_asked_for(depth_m: float) -> None:
    (warning,) = warnings(Adjusted(depth_m=depth_m))
    assert "is the unit of the poses the metre" in warning
    assert warnings(Adjusted(depth_m=None)) == []


def test_shared_errors_of_stated_positions_are_said() -> None:
    (warning,) = warnings(Adjusted(shared_mm=1.9))
    assert warning.startswith(
        "the stated positions deform smoothly, by 1.9 mm per axis"
    )
    assert warnings(Adjusted(shared_mm=0.3)) == []
