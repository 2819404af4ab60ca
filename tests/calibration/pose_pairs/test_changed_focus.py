"""Distances from camera to board that change with the focal length."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.hand_eye import Setting, recording
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import solve_pose_pairs
from evercal.geometry import SE3
from evercal.robot.mount import MountName

NOISE = Setting(path="table", poses=20, noise_mm=0.1, noise_deg=0.02)


def warnings(setting: Setting, seed: int, zoom: np.ndarray) -> str:
    """Warnings of a recording whose distances are multiplied by `zoom` (n,)."""
    pairs = recording(setting, seed).pairs
    camera = pairs.camera_from_board
    scaled = SE3(camera.rotation_wxyz, camera.translation_m * zoom[:, None])
    changed = PosePairs(pairs.names, pairs.base_from_gripper, scaled)
    return " ".join(solve_pose_pairs(changed, setting.mount).warnings)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("seed", range(3))
def test_autofocus_is_named(mount: MountName, seed: int) -> None:
    rng = np.random.default_rng(seed)
    zoom = 1 + rng.uniform(-0.015, 0.015, 20)
    words = warnings(replace(NOISE, mount=mount), seed, zoom)
    assert "distances from camera to board change by" in words
    assert "from image to image" in words


@pytest.mark.parametrize("first", [7, 12])
@pytest.mark.parametrize("size", [0.02, -0.012])
def test_a_new_focus_is_named_with_its_image(first: int, size: float) -> None:
    zoom = np.where(np.arange(20) >= first, 1 + size, 1.0)
    assert "distances from camera to board change by" in warnings(NOISE, first, zoom)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("noise_mm", [0.1, 2.0, 10.0])
@pytest.mark.parametrize("at", ["own", "far"])
def test_one_focus_is_not_accused(mount: MountName, noise_mm: float, at: str) -> None:
    setting = replace(NOISE, mount=mount, noise_mm=noise_mm, at=at, noisy="both")
    setting = replace(setting, noise_deg=noise_mm / 10)
    for seed in range(8):
        assert "focus" not in warnings(setting, seed, np.ones(20))
