"""What a calibration is good for, in plain words."""

from dataclasses import dataclass

from evercal.calibration.calibration import Calibration


@dataclass(frozen=True)
class Tier:
    """A use and what it asks for."""

    name: str
    """The use."""
    mm: float
    """Error in millimetres that it bears."""
    deg: float
    """Error in degrees that it bears."""


TIERS = (
    Tier("precision assembly", 1.0, 0.1),
    Tier("bin picking", 3.0, 0.3),
    Tier("tabletop tasks", 10.0, 1.0),
)
"""The most demanding first; what misses the last one is unusable."""


def tier(calibration: Calibration) -> Tier | None:
    """The most demanding use that it serves, None if it serves none.

    The uncertainty of the answer decides, as the expected distance in space, and where a check on
    poses that were left out was made, its error as well: a small uncertainty beside a large error
    means that the model of rigid motion does not hold.
    """
    mm, deg = expected_error(calibration)
    return next((t for t in TIERS if mm < t.mm and deg < t.deg), None)


def expected_error(calibration: Calibration) -> tuple[float, float]:
    """Millimetres and degrees: the largest of the uncertainty and of what the checks found.

    Two halves of the data differ by twice as much as the answer from both is off.
    """
    mm, deg = _expected(calibration)
    for check, share in (("held_out", 1.0), ("repeatability", 0.5)):
        mm = max(mm, share * float(calibration.checks.get(f"{check}_mm") or 0.0))
        deg = max(deg, share * float(calibration.checks.get(f"{check}_deg") or 0.0))
    return mm, deg


def verdict(calibration: Calibration) -> str:
    """One to three sentences: what it is good for, why, and what would make it better."""
    found = tier(calibration)
    mm, deg = _expected(calibration)
    if found is None:
        first = (
            f"Unusable: even tabletop tasks ask for {TIERS[-1].mm:g} mm and {TIERS[-1].deg:g} deg."
        )
    else:
        first = f"Good for {found.name} (within {found.mm:g} mm and {found.deg:g} deg)."
    known = f"Expected error {_length(mm)} and {deg:.2f} deg"
    held_out = _held_out(calibration)
    if held_out is None:
        return f"{first} {known}."
    known = f"{known}; the median error on held-out poses is {_length(held_out[0])} and"
    return f"{first} {known} {held_out[1]:.2f} deg. {_advice(found, (mm, deg), held_out)}"


def _advice(found: Tier | None, known: tuple[float, float], held_out: tuple[float, float]) -> str:
    if found is TIERS[0]:
        return "Check it on the robot before use: touch a point that the camera sees."
    wanted = TIERS[-1] if found is None else TIERS[TIERS.index(found) - 1]
    sigma_lacks = known[0] >= wanted.mm or known[1] >= wanted.deg
    held_out_lacks = held_out[0] >= wanted.mm or held_out[1] >= wanted.deg
    if sigma_lacks and not held_out_lacks:
        return f"More poses, tilted more about two axes, bring it nearer to {wanted.name}."
    if sigma_lacks:
        return (
            f"For {wanted.name} single poses are too far off: let the robot stand still at each,"
            f" use a larger or nearer board, check intrinsics, then record more poses."
        )
    return (
        f"More images will not help for {wanted.name}: each pose of robot or camera is off by about"
        f" that much; let the robot stand still at each, use a larger or nearer board, check"
        f" intrinsics and the arm's own calibration."
    )


def _expected(calibration: Calibration) -> tuple[float, float]:
    """Root mean square error in space, millimetres and degrees."""
    return 3**0.5 * calibration.sigma_mm, 3**0.5 * calibration.sigma_deg


def _held_out(calibration: Calibration) -> tuple[float, float] | None:
    checks = calibration.checks
    if "held_out_mm" not in checks or "held_out_deg" not in checks:
        return None
    return float(checks["held_out_mm"]), float(checks["held_out_deg"])


def _length(mm: float) -> str:
    return f"{mm:.2f} mm" if mm < 10 else f"{mm:.0f} mm"
