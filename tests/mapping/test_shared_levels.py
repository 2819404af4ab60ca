"""Errors that gripper poses share, in bundle adjustment: taken in where images ask for them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from evercal.geometry import SE3
from evercal.mapping.build import MapOptions
from evercal.mapping.bundle_adjustment import BundleAdjustment
from evercal.mapping.bundle_equations import Adjustment
from evercal.mapping.stated_errors import StatedErrors
from evercal.robot.known_arms import known_arm
from evercal.robot.mount import EYE_IN_HAND
from evercal.robot.pose_errors import ArmErrors, SharedErrors, shared_errors

from .projected_tracks import CAMERA, world

MOUNT = SE3.from_translation((0.02, 0.05, 0.03))
POSES = 16


def adjusted(seed: int, offset_deg: float, errors: ArmErrors | None) -> Adjustment:
    """A wrist recording of an arm whose inner joints are off; `errors` is what is known of it."""
    rng = np.random.default_rng(seed)
    arm = known_arm("ur5e")
    assert arm.ranges is not None
    joints = arm.ranges[:, 1] + rng.uniform(-0.4, 0.4, (POSES, 6))
    offsets = np.deg2rad(offset_deg) * rng.normal(size=6) * (0, 1, 1, 1, 1, 0)
    stated = arm.poses(joints - offsets)
    stated = stated @ SE3.exp(rng.normal(0, 1e-4, (POSES, 6)))
    made = world(noise_px=0.1, truth=arm.poses(joints) @ MOUNT, every=2)
    kinds: Mapping[str, SharedErrors] | None = None
    if errors is not None:
        kinds = shared_errors(stated, errors)
    problem = BundleAdjustment(
        stated @ MOUNT,
        [CAMERA] * POSES,
        StatedErrors(np.zeros((POSES, 6)), SE3.stack([MOUNT] * POSES), None, kinds),
        MapOptions().for_hand_eye(EYE_IN_HAND).bundle,
    )
    return problem.solve(made.tracks)


def off(result: Adjustment) -> tuple[float, float]:
    """Rotation of the common transform, which is none, degrees; its squared distance."""
    error = result.common.log()
    spread = result.common_covariance + result.common_systematic
    degrees = float(np.rad2deg(np.linalg.norm(error[3:])))
    return degrees, float(error @ np.linalg.solve(spread, error))


@pytest.mark.parametrize("seed", [1, 2])
def test_offsets_of_a_named_arm_leave_the_transform(seed: int) -> None:
    independent = off(adjusted(seed, 1.0, None))
    named = off(adjusted(seed, 1.0, ArmErrors(known_arm("ur5e"))))
    assert named[0] < independent[0] / 3
    assert named[1] < 12.6


def test_independent_errors_stay_independent() -> None:
    alone = adjusted(3, 0.0, None)
    asked = adjusted(3, 0.0, ArmErrors())
    assert asked.common_covariance == pytest.approx(alone.common_covariance, rel=1e-6)
