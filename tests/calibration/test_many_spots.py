"""The covariance of a camera on the gripper contains an error of the base frame in full."""

from __future__ import annotations

import numpy as np
import pytest

from evercal.calibration.from_images import _from_many_spots as from_many_spots
from evercal.calibration.located import ImagePose, deviations, fuse, in_gripper_frame
from evercal.geometry import SE3, UncertainPose
from evercal.localization.estimate import PoseEstimate

GRIPPER_FROM_CAMERA = SE3.exp([0.05, 0.02, 0.1, 0.1, 0.2, -0.3])
DOWN = SE3.exp([0, 0, 0, np.pi, 0, 0])


def drawn(pose: SE3, error: np.ndarray) -> SE3:
    """A pose with errors of its position, and about camera axes."""
    turned = pose @ SE3.exp(np.r_[0, 0, 0, error[3:]])
    return SE3(turned.rotation_wxyz, pose.translation_m + error[:3])


def squared_distance(seed: int, base_mm: float) -> float:
    """Squared Mahalanobis distance of one calibration from 15 spots."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat([base_mm / 1000, np.deg2rad(0.05) * base_mm], 3)
    base = np.diag(sigma**2) + 1e-16 * np.eye(6)
    own = np.diag(np.repeat([0.3e-3, np.deg2rad(0.02)], 3) ** 2)
    motion = drawn(SE3.identity(), rng.normal(0, sigma))
    places = np.array([0.5, 0, 0.5]) + rng.uniform(-0.25, 0.25, (15, 3))
    turns = SE3.exp(np.pad(rng.uniform(-0.5, 0.5, (15, 3)), ((0, 0), (3, 0))))
    grippers = SE3.from_translation(places) @ DOWN @ turns
    located = []
    for i, camera in enumerate(grippers @ GRIPPER_FROM_CAMERA):
        pose = motion @ drawn(camera, rng.multivariate_normal(np.zeros(6), own))
        answer = UncertainPose(SE3.identity(), base) @ UncertainPose(pose, own)
        estimate = PoseEstimate("ok", "", "hall", pose, answer.covariance, 100, 0.5, 1.0)
        located.append(ImagePose(str(i), estimate, pose, answer.covariance))
    moved = in_gripper_frame(located, grippers)
    fused = fuse(moved)
    covariance, terms = from_many_spots(located, moved, fused, grippers, base)
    assert sum(term.name == "base frame" for term in terms) == 1
    error = deviations(SE3.stack([fused.pose]), GRIPPER_FROM_CAMERA)[0]
    return float(error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize("base_mm", [0.0, 1.0])
def test_errors_are_as_large_as_stated(base_mm: float) -> None:
    # The mean of a chi-squared of six dimensions is 6; few spots and a robust mean add to it.
    assert 2 < np.mean([squared_distance(seed, base_mm) for seed in range(20)]) < 10
