"""What a calibration is good for, in plain words."""

from dataclasses import dataclass

from evercal.calibration.calibration import Calibration


@dataclass(frozen=True)
class Tier:
    """A kind of use and what it asks for."""

    name: str
    """For people."""
    most_mm: float
    """Largest expected error of the position."""
    most_deg: float
    """Largest expected error of the rotation."""


TIERS = (
    Tier("precision assembly", 1.0, 0.1),
    Tier("bin picking", 3.0, 0.3),
    Tier("tabletop manipulation", 10.0, 1.0),
)
"""From the finest on; what fits none of them is unusable."""
ERRORS = (("held_out_mm", "held_out_deg"), ("repeatability_mm", "repeatability_deg"))


def expected_error(calibration: Calibration) -> tuple[float, float]:
    """Millimetres and degrees: the larger of the uncertainty's length and of the checks' errors."""
    # The length of an error with three Gaussian axes is 1.73 standard deviations, root mean square.
    millimetres, degrees = 1.73 * calibration.sigma_mm, 1.73 * calibration.sigma_deg
    for mm, deg in ERRORS:
        millimetres = max(millimetres, float(calibration.checks.get(mm) or 0.0))
        degrees = max(degrees, float(calibration.checks.get(deg) or 0.0))
    return millimetres, degrees


def tier(calibration: Calibration) -> Tier | None:
    """The finest use it is good enough for; None where it is unusable."""
    millimetres, degrees = expected_error(calibration)
    return next((t for t in TIERS if millimetres <= t.most_mm and degrees <= t.most_deg), None)


def verdict(calibration: Calibration) -> str:
    """One sentence."""
    millimetres, degrees = expected_error(calibration)
    good = tier(calibration)
    about = f"expected error {millimetres:.1f} mm and {degrees:.2f} deg"
    if good is None:
        return f"Not usable: {about}; do not let a robot act on it."
    finer = TIERS[: TIERS.index(good)]
    return f"Good enough for {good.name} ({about})" + (
        f", not for {finer[-1].name}." if finer else "."
    )
