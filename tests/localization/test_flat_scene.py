"""Before a flat scene a wrong camera gives no precise answer."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from evercal.geometry import Camera
from evercal.localization.intrinsics import (
    NOT_STATED,
    STATED,
    IntrinsicsPrior,
)
from evercal.localization.pose_refinement import Observed
from evercal.localization.self_calibration import self_calibrated

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)


def answer(
    prior: IntrinsicsPrior, longer: float, tilt: float, seed: int = 0
) -> tuple[float, float]:
    """Error and standard deviation, metres, of a camera before a wall at 2 m.

    It has another focal length than is supposed.
    """
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((5, 5), (634, 474), (400, 2))
    camera = CAMERA.zoomed(longer)
    rays = camera.unproject(pixels)
    normal = np.array([np.sin(tilt), 0, np.cos(tilt)])
    points = rays * (2 / (rays @ normal))[:, None]
    white = np.repeat(10 * np.eye(2)[..., None], 400, 2)
    seen = Observed(pixels + rng.normal(0, 0.05, pixels.shape), points, white)
    refined = self_calibrated(
        seen, CAMERA, (np.eye(3), np.zeros(3)), np.zeros(5), prior
    )
    for _ in range(3):
        at = refined.pose.pose.rotation_matrix(), refined.pose.pose.translation_m
        refined = self_calibrated(seen, CAMERA, at, refined.change, prior)
    sigma = float(np.sqrt(np.trace(refined.pose.covariance[:3, :3]) / 3))
    return float(np.linalg.norm(refined.pose.pose.translation_m)), sigma


@pytest.mark.parametrize(
    ("prior", "longer", "tilt"),
    [
        *product([NOT_STATED], [1.05, 1.15], [0.2, 0.4, 0.6]),
        *product([NOT_STATED], [1.02], [0.3, 0.4, 0.6]),  # less tilt hides two percent
        *product([STATED], [1.05, 1.15], [0.4, 0.6]),
        (STATED, 1.02, 0.6),
    ],
)
def test_a_wrong_focal_length_is_wide(
    prior: IntrinsicsPrior, longer: float, tilt: float
) -> None:
    for seed in range(5):
        error, sigma = answer(prior, longer, tilt, seed)
        assert error < 0.01 or sigma > 0.05 or error < 4 * sigma


@pytest.mark.parametrize("prior", [NOT_STATED, STATED])
def test_the_right_one_is_precise(prior: IntrinsicsPrior) -> None:
    error, sigma = answer(prior, 1.0, 0.4)
    assert error < 0.002
    assert sigma < 0.012
