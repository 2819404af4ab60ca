"""Uses that a calibration is good for, in plain words."""

from typing import NamedTuple

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.geometry import cross_matrix
from evercal.typing import Pair


class Tier(NamedTuple):
    """A use and the errors that it tolerates."""

    name: str
    mm: float
    deg: float


TIERS = (
    Tier("precision assembly", 1.0, 0.1),
    Tier("bin picking", 3.0, 0.3),
    Tier("tabletop tasks", 10.0, 1.0),
)
"""The most demanding first; a calibration that misses the last one is unusable."""


def tier(calibration: Calibration) -> Tier | None:
    """Return the most demanding use that a calibration serves, by its own error."""
    mm, deg = expected_error(calibration)
    for use in TIERS:
        if mm < use.mm and deg < use.deg:
            return use
    return None


def expected_error(calibration: Calibration) -> Pair:
    """Return the root mean square error in space, millimetres and degrees.

    The position counts at the distance of the target along the optical axis (`target_m` of the
    checks), or at the camera if that is larger. Halves of the data differ by twice the error.
    """
    checks = calibration.checks
    target = float(checks.target_m or 0.0)
    rotation = calibration.parent_from_child.rotation_matrix()
    lever = -rotation @ cross_matrix([0.0, 0.0, target])
    slope = np.concatenate([np.eye(3), lever], 1)
    covariance = slope @ calibration.covariance @ slope.T
    at_target = float(np.sqrt(np.trace(covariance)))
    half_mm = float(checks.repeatability_mm or 0.0) / 2
    half_deg = float(checks.repeatability_deg or 0.0) / 2
    mm = max(3**0.5 * calibration.sigma_mm, 1000 * at_target, half_mm)
    return mm, max(3**0.5 * calibration.sigma_deg, half_deg)


def verdict(calibration: Calibration) -> str:
    """Return one to three sentences: possible uses, the reason, and advice."""
    use = tier(calibration)
    mm, deg = expected_error(calibration)
    checks = calibration.checks
    first = f"Unusable: even tabletop tasks ask for {TIERS[-1].mm:g} mm and {TIERS[-1].deg:g} deg."
    if use:
        first = f"Good for {use.name} (within {use.mm:g} mm and {use.deg:g} deg)."
    first = f"{first} Expected error {_length(mm)} and {deg:.2f} deg"
    if checks.target_m:
        first += f", {checks.target_m:.2f} m from the camera"
    if checks.held_out_mm is None or checks.held_out_deg is None:
        return f"{first}."
    held_out = f"{_length(checks.held_out_mm)} and {checks.held_out_deg:.2f} deg"
    return (
        f"{first}; single held-out poses differ by {held_out} (median). {_advice(use)}"
    )


def _advice(use: Tier | None) -> str:
    if use is TIERS[0]:
        return "Check it on the robot before use, with points that it touches: 'evercal verify'."
    wanted = TIERS[-1]
    if use:
        wanted = TIERS[TIERS.index(use) - 1]
    return (
        f"For {wanted.name}: more poses, tilted more about two axes; let the robot stand still at"
        " each; use larger or nearer surfaces with texture, or such a board."
    )


def _length(mm: float) -> str:
    return f"{mm:.2f} mm" if mm < 10 else f"{mm:.0f} mm"
