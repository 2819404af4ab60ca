"""Verdicts: uncertainty and checks decide, and the advice names what lacks."""

import numpy as np
import pytest

from evercal.calibration.calibration import Calibration
from evercal.calibration.verdict import TIERS, expected_error, tier, verdict
from evercal.geometry import SE3


def made(mm: float, deg: float, **checks: float) -> Calibration:
    """An answer that is known to this distance in space."""
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
def test_the_worse_of_both_decides(mm: float, deg: float, name: str | None) -> None:
    found = tier(made(mm, deg))
    assert (found.name if found else None) == name
    says = verdict(made(mm, deg))
    assert says.startswith(f"Good for {name}" if name else "Unusable")


def test_checks_count_as_much_as_the_uncertainty() -> None:
    sure = made(0.5, 0.05, held_out_mm=2.0, held_out_deg=0.2)
    assert tier(sure) is TIERS[1]
    assert "More images will not help for precision assembly" in verdict(sure)
    unsure = made(2.0, 0.05, held_out_mm=0.5, held_out_deg=0.05)
    assert tier(unsure) is TIERS[1]
    assert "More poses" in verdict(unsure)
    neither = made(2.0, 0.2, held_out_mm=2.0, held_out_deg=0.2)
    assert "larger or nearer board" in verdict(neither)
    # Two halves differ by twice what the answer from both is off.
    assert expected_error(made(0.5, 0.05, repeatability_mm=3.0)) == pytest.approx((1.5, 0.05))
