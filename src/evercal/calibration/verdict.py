"""Uses that a calibration is good for, in plain words."""

from typing import NamedTuple

from evercal.calibration.calibration import Calibration


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
    """Return the most demanding use that a calibration serves.

    Its uncertainty and the errors of its checks decide: a small uncertainty beside a large error
    means that the model of rigid motion does not hold.
    """
    mm, deg = expected_error(calibration)
    return next((t for t in TIERS if mm < t.mm and deg < t.deg), None)


def expected_error(calibration: Calibration) -> tuple[float, float]:
    """Return millimetres and degrees: the largest of the uncertainty and the errors of the checks.

    Two halves of the data differ by twice the error of their mean.
    """
    mm, deg = _sigma_in_space(calibration)
    for check, share in (("held_out", 1.0), ("repeatability", 0.5)):
        mm = max(mm, share * float(calibration.checks.get(f"{check}_mm") or 0.0))
        deg = max(deg, share * float(calibration.checks.get(f"{check}_deg") or 0.0))
    return mm, deg


def verdict(calibration: Calibration) -> str:
    """Return one to three sentences: possible uses, the reason, and advice."""
    use, sigma, checks = tier(calibration), _sigma_in_space(calibration), calibration.checks
    first = f"Unusable: even tabletop tasks ask for {TIERS[-1].mm:g} mm and {TIERS[-1].deg:g} deg."
    if use is not None:
        first = f"Good for {use.name} (within {use.mm:g} mm and {use.deg:g} deg)."
    first = f"{first} Expected error {_length(sigma[0])} and {sigma[1]:.2f} deg"
    if "held_out_mm" not in checks or "held_out_deg" not in checks:
        return f"{first}."
    held_out = float(checks["held_out_mm"]), float(checks["held_out_deg"])
    return (
        f"{first}; the median error on held-out poses is {_length(held_out[0])} and"
        f" {held_out[1]:.2f} deg. {_advice(use, sigma, held_out)}"
    )


def _advice(use: Tier | None, sigma: tuple[float, float], held_out: tuple[float, float]) -> str:
    if use is TIERS[0]:
        return "Check it on the robot before use: touch a point that the camera sees."
    wanted = TIERS[-1] if use is None else TIERS[TIERS.index(use) - 1]
    sigma_lacks = sigma[0] >= wanted.mm or sigma[1] >= wanted.deg
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


def _sigma_in_space(calibration: Calibration) -> tuple[float, float]:
    """Root mean square error in space, millimetres and degrees."""
    return 3**0.5 * calibration.sigma_mm, 3**0.5 * calibration.sigma_deg


def _length(mm: float) -> str:
    return f"{mm:.2f} mm" if mm < 10 else f"{mm:.0f} mm"
