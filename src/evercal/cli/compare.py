"""`evercal compare`."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args

_LINES = """\
{0.verdict}
  rays         {0.rays_deg[0]:.3f} deg apart, {0.rays_mm[0]:.2f} mm at {0.distance_m:g} m
    90 % below {0.rays_deg[1]:.3f} deg, {0.rays_mm[1]:.2f} mm
  camera       {0.pose_mm:.2f} mm, {0.pose_deg:.3f} deg apart
  stated       {0.sigma_mm:.2f} mm, {0.sigma_deg:.3f} deg (standard deviation of it per axis)
  intrinsics   {0.left_deg:.3f} deg between rays that no pose explains
  in common    {1}: such errors do not show here"""
"""Text of a `Comparison`, and of what both share."""


@frozen
class Compare(args.Verb):
    """Compare two calibrations of one camera by their rays; exit code 1 if they disagree.

    A frame belongs to its intrinsics. So the second one is turned for the intrinsics of the first
    before both are compared.

    Example: evercal compare monday.json friday.json
    """

    first: Annotated[Positional[Path], arg(metavar="A.json")]
    """Calibration file, or a map that was learned from gripper poses (MAP or MAP:SCENE)."""
    second: Annotated[Positional[Path], arg(metavar="B.json")]
    """The same of the other calibration."""
    distance: Annotated[float | None, args.shown("M")] = None
    """Working distance, metres. Default: that of the board, or 0.5 m."""

    def run(self) -> int:
        from evercal.calibration.learned import calibration_at

        first = calibration_at(self.first)
        compared = first.distance(calibration_at(self.second), self.distance)
        shared = ", ".join(compared.shared) or "nothing"
        lines = _LINES.format(compared, shared).splitlines()
        lines += map("  note         {}".format, compared.notes)
        self.answer(compared.to_dict(), *lines)
        return 0 if compared.agree else 1
