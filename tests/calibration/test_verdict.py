"""Verdicts from uncertainty and checks, and their advice."""

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


def test_checks_count_like_the_uncertainty() -> None:
    precise = calibration(0.5, 0.05, held_out_mm=2.0, held_out_deg=0.2)
    assert tier(precise) is TIERS[1]
    assert "More images will not help for precision assembly" in verdict(precise)
    imprecise = calibration(2.0, 0.05, held_out_mm=0.5, held_out_deg=0.05)
    assert tier(imprecise) is TIERS[1]
    assert "More poses" in verdict(imprecise)
    poor = calibration(2.0, 0.2, held_out_mm=2.0, held_out_deg=0.2)
    assert "larger or nearer board" in verdict(poor)
    # Two halves differ by twice the error of their mean.
    assert expected_error(calibration(0.5, 0.05, repeatability_mm=3.0)) == pytest.approx(
        (1.5, 0.05)
    )
