"""Verdicts from uncertainty and checks, and their advice."""

from dataclasses import replace

import numpy as np
import pytest

from evercal.calibration.calibration import Calibration
from evercal.calibration.verdict import TIERS, expected_error, tier, verdict
from evercal.geometry import SE3


def calibration(mm: float, deg: float, **checks: float) -> Calibration:
    """A calibration with this root mean square error in space."""
    axes = np.repeat([mm / 1000, np.deg2rad(deg)], 3) / np.sqrt(3)
    return Calibration("eye_in_hand", SE3.identity(), np.diag(axes**2), "gripper", checks=checks)


@pytest.mark.parametrize(
    ("mm", "deg", "name"),
    [
        (0.9, 0.09, "precision assembly"),
        (1.1, 0.09, "bin picking"),
        (0.9, 0.11, "bin picking"),
        (3.1, 0.1, "tabletop tasks"),
        (9.9, 0.9, "tabletop tasks"),
        (0.1, 1.1, None),
        (10.1, 0.1, None),
    ],
)
def test_worse_of_translation_and_rotation_decides(mm: float, deg: float, name: str | None) -> None:
    use = tier(calibration(mm, deg))
    assert (use.name if use else None) == name
    assert verdict(calibration(mm, deg)).startswith(f"Good for {name}" if name else "Unusable")


def test_the_noise_of_single_poses_is_no_error_of_the_calibration() -> None:
    # A single tag in 241 images: one pose is off by 30 mm, the calibration by half a millimetre.
    noisy = calibration(0.5, 0.05, held_out_mm=30.0, held_out_deg=3.0)
    assert tier(noisy) is TIERS[0]
    assert "single held-out poses differ by 30 mm" in verdict(noisy)
    assert "more poses" in verdict(calibration(2.0, 0.05, held_out_mm=0.5, held_out_deg=0.05))
    # Two halves differ by twice the error of their mean.
    halves = calibration(0.5, 0.05, repeatability_mm=3.0)
    assert expected_error(halves) == pytest.approx((1.5, 0.05))


def test_a_rotation_error_counts_at_the_target() -> None:
    near, far = (calibration(0.5, 0.1, target_m=target) for target in (0.0, 2.0))
    assert expected_error(near)[0] == pytest.approx(0.5)
    # Two of three axes move the target: 2 m times 0.1 deg times sqrt(2 / 3).
    moved = 2000 * np.deg2rad(0.1) * np.sqrt(2 / 3)
    assert expected_error(far)[0] == pytest.approx(np.hypot(0.5, moved))
    assert "2.00 m from the camera" in verdict(replace(far, checks={"target_m": 2.0}))
