"""Distances from camera to board that change with the focal length."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.board_recordings import BoardSetting, corner_pairs, pose_pairs, record
from evercal.calibration.pose_pairs.solve import solve_pose_pairs
from evercal.geometry import SE3
from evercal.robot.mount import MountName


def with_corners(mount: MountName, seed: int, zoom: np.ndarray) -> str:
    """Warnings of a recording of corners, whose focal length is multiplied by `zoom` (n,)."""
    made = record(BoardSetting(mount, views=len(zoom)), seed)
    middle = np.array([made.camera.cx, made.camera.cy])
    views = []
    for view, factor in zip(made.views, zoom, strict=True):
        pixels = middle + factor * (view.pixels - middle)
        views.append(replace(view, pixels=pixels))
    pairs, corners = corner_pairs(replace(made, views=tuple(views)))
    solution = solve_pose_pairs(pairs, mount, corners=corners)
    return " ".join(solution.warnings)


def without_corners(seed: int, zoom: np.ndarray, depth_noise: float = 0.0) -> str:
    """The same of pose pairs, whose distances are multiplied."""
    setting = BoardSetting(views=len(zoom), depth_noise=depth_noise)
    pairs = pose_pairs(record(setting, seed), seed)
    camera = pairs.camera_from_board
    scaled = SE3(camera.rotation_wxyz, camera.translation_m * zoom[:, None])
    changed = replace(pairs, camera_from_board=scaled)
    return " ".join(solve_pose_pairs(changed, setting.mount).warnings)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_autofocus_is_named(mount: MountName) -> None:
    for seed in range(2):
        zoom = 1 + np.random.default_rng(seed).uniform(-0.015, 0.015, 20)
        words = with_corners(mount, seed, zoom)
        assert "distances from camera to board change by" in words
        assert "from image to image" in words


@pytest.mark.parametrize("first", [7, 12])
@pytest.mark.parametrize("size", [0.02, -0.02])
def test_a_new_focus_is_named_with_its_image(first: int, size: float) -> None:
    zoom = np.where(np.arange(20) >= first, 1 + size, 1.0)
    named = f"at {first}.png"
    assert named in with_corners("eye_in_hand", first, zoom)
    assert "distances from camera to board change" in without_corners(first, zoom)


@pytest.mark.parametrize("seed", range(4))
def test_one_focus_is_not_accused(seed: int) -> None:
    still = np.ones(20)
    assert "focus" not in with_corners("eye_in_hand", seed, still)
    assert "focus" not in with_corners("eye_to_hand", seed, still)
    for noise in (0.0, 0.004, 0.01):
        assert "focus" not in without_corners(seed, still, noise)
