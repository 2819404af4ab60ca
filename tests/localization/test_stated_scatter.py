"""The scatter of stated poses about the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.learning.stated_scatter import intrinsics_sigma, scatter, with_scatter
from evercal.mapping.scene_map import LeftOut, MapContents
from evercal.recordings.frame import Frame, Recording
from evercal.typing import Array


def test_only_the_newest_scene_is_fitted(
    hall: Recording, hall_map: MapContents
) -> None:
    second = replace(hall_map.scenes[0], name="second")
    both = hall_map.with_scene(second)
    scene = with_scatter(both, hall.test[::20])
    assert scene.name == "second"
    assert scene.keyframes is second.keyframes


def test_shared_errors_of_held_out_poses_widen_the_stated_frame(
    hall: Recording, hall_map: MapContents
) -> None:
    def off(frames: Sequence[Frame], metres: float) -> list[Frame]:
        shift = SE3.exp([metres, 0, 0, 0, 0, 0])
        stated = [(frame, frame.base_from_camera) for frame in frames]
        return [
            replace(f, base_from_camera=shift @ pose)
            for f, pose in stated
            if pose is not None
        ]

    held_out = hall.test[::3]
    few = with_scatter(hall_map, off(held_out[:7], 0.02))
    assert few.frame.frame_sigma == (0.0, 0.0)
    exact = with_scatter(hall_map, held_out).frame.frame_sigma
    assert max(exact) < 2e-4
    metres, radians = with_scatter(hall_map, off(held_out, 0.02)).frame.frame_sigma
    assert 0.01 < metres < 0.02
    assert radians == pytest.approx(exact[1], rel=0.1)
    # Independent noise of stated poses is no error of an answer.
    noisy = with_scatter(hall_map, off(held_out, 0.02), noise=(0.02, 0.0))
    assert noisy.frame.frame_sigma[0] < 0.6 * metres
    # A wrong pose is no scatter.
    some = [*off(held_out[:2], 0.9), *held_out[2:]]
    assert max(with_scatter(hall_map, some).frame.frame_sigma) < 2e-4


def test_scatter_restores_the_distribution() -> None:
    rng = np.random.default_rng(0)
    covariances = np.stack([np.diag(rng.uniform(0.5, 2, 3)) for _ in range(2000)])
    own = np.sqrt(np.einsum("nii->ni", covariances)) * rng.normal(size=(2000, 3))
    errors = own + 3 * rng.normal(size=(2000, 3))
    assert scatter(errors, covariances) == pytest.approx(3.0, rel=0.05)
    assert scatter(0.9 * own, covariances) < 0.1
    # Few errors leave room for a larger one; one that is far off does not count.
    assert scatter(errors[:20], covariances[:20]) > 1.1 * 3.0
    errors[:50] *= 100
    assert scatter(errors, covariances) == pytest.approx(3.0, rel=0.06)


def test_intrinsics_that_move_are_measured_with_their_noise() -> None:
    rng = np.random.default_rng(0)
    camera = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
    noise = np.square([2e-3, 0.7, 0.7, 0.02, 0.03])
    still = np.zeros(5)
    moving = np.square([1e-3, 3.0, 3.0, 0.0, 0.0])

    def sigma(variances: Array) -> tuple[float, float, float]:
        deviations = np.sqrt(noise + variances)
        changes = deviations * rng.normal(size=(60, 5))
        return intrinsics_sigma(changes, np.tile(np.diag(noise), (60, 1, 1)), camera)

    focal, centre, distortion = sigma(moving)
    assert centre * 320 == pytest.approx(3.0, rel=0.2)
    assert focal < 2e-3
    focal, centre, distortion = sigma(still)
    assert focal < 1e-3
    assert centre * 320 < 0.4
    assert distortion < 0.012


def test_frames_far_from_keyframes_widen_the_stated_frame(
    hall: Recording, hall_map: MapContents
) -> None:
    shift = SE3.exp([0.02, 0, 0, 0, 0, 0])
    part = [
        replace(frame, base_from_camera=shift @ frame.base_from_camera)
        for frame in hall.test[:8]
        if frame.base_from_camera is not None
    ]
    count = len(hall_map.scenes[0].keyframes)
    left_out = [LeftOut(tuple(part), np.arange(count))]
    scene = with_scatter(hall_map, (), left_out=left_out)
    assert 0.008 < scene.frame.frame_sigma[0] < 0.025
    assert len(scene.keyframes) == count
