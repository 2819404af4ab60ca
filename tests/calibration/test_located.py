"""Poses of one camera from several images are fused robustly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from evercal.calibration.located import ImagePose, fuse, halves_apart
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.localization.estimate import PoseEstimate


def estimate(scene: str | None, reason: str = "") -> PoseEstimate:
    pose = None if scene is None else SE3.identity()
    status = "unknown_scene" if scene is None else "ok"
    return PoseEstimate(status, reason, scene, pose, np.eye(6) * 1e-6, 100, 0.5, 1.0)


def located(
    poses: SE3,
    scenes: Sequence[str | None] | None = None,
    bases: Sequence[str] | None = None,
) -> list[ImagePose]:
    names = scenes or ["room"] * len(poses)
    covariance = np.eye(6) * 1e-6
    items = []
    for i, pose in enumerate(poses):
        found = estimate(names[i], "too dark")
        base = str(names[i]) if bases is None else bases[i]
        items.append(ImagePose(f"{i}.png", found, pose, covariance, base))
    return items


def scattered(count: int, seed: int = 0, sigma: float = 5e-4) -> tuple[SE3, SE3]:
    rng = np.random.default_rng(seed)
    truth = SE3.exp(rng.normal(0, 1, 6))
    return truth, truth @ SE3.exp(rng.normal(0, sigma, (count, 6)))


def test_outliers_are_rejected() -> None:
    truth, poses = scattered(20)
    far = truth @ SE3.exp([0.03, 0, 0, 0, 0, 0])
    rotated = truth @ SE3.exp([0, 0, 0, 0, 0.05, 0])
    fused = fuse(located(SE3.stack([*poses, far, rotated])))
    assert fused.used.tolist() == [True] * 20 + [False] * 2
    assert "30.0 mm" in fused.uses[20].reason
    assert "2.8" in fused.uses[21].reason
    metres, radians = pose_distance(fused.pose, truth)
    assert metres < 5e-4
    assert radians < 5e-4


def test_scatter_is_the_covariance_of_one_image() -> None:
    _, poses = scattered(400, sigma=1e-3)
    scatter = fuse(located(poses)).scatter
    assert np.sqrt(np.diag(scatter)) == pytest.approx([1e-3] * 6, rel=0.15)


def test_images_of_other_scenes_are_named() -> None:
    _, poses = scattered(5)
    fused = fuse(located(poses, ["room", "hall", None, "room", "room"]))
    assert fused.scene == "room"
    assert fused.used.tolist() == [True, False, False, True, True]
    assert fused.uses[1].reason == "shows scene hall; most images show room"

    assert fused.uses[2].reason == "unknown scene: too dark"


def test_scenes_of_one_base_are_fused() -> None:
    _, poses = scattered(5)
    scenes = ["room", "hall", "far", "hall", "room"]
    fused = fuse(located(poses, scenes, ["room", "room", "far", "room", "room"]))
    assert fused.used.tolist() == [True, True, False, True, True]
    assert fused.uses[2].reason.startswith("shows scene far")
    with pytest.raises(InputError, match="0 of 2 images were located"):
        fuse(located(poses[:2], [None, None]))


def test_repeatability_needs_four_images() -> None:
    _, poses = scattered(40, sigma=1e-3)
    assert halves_apart(poses[:3]) is None
    halves = halves_apart(poses)
    assert halves is not None
    # Two means of 20 poses with 1 mm per axis differ by some tenths of a millimetre.
    assert 0.05 < halves[0] < 2.0
