"""`evercal compare`."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli import args

if TYPE_CHECKING:
    from evercal.calibration.comparison import Comparison


@dataclass(frozen=True)
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
        self.answer(compared.to_dict(), *_lines(compared))
        return 0 if compared.agree else 1


def _lines(compared: "Comparison") -> Iterator[str]:
    angle, largest = compared.rays_deg
    mm, most = compared.rays_mm
    yield compared.verdict
    yield (
        f"  rays         {angle:.3f} deg apart, {mm:.2f} mm at {compared.distance_m:g} m"
        f" (90 % below {largest:.3f} deg, {most:.2f} mm)"
    )
    yield f"  camera       {compared.pose_mm:.2f} mm, {compared.pose_deg:.3f} deg apart"
    spread = f"{compared.sigma_mm:.2f} mm, {compared.sigma_deg:.3f} deg"
    yield f"  stated       {spread} (standard deviation of the difference per axis)"
    yield f"  intrinsics   {compared.left_deg:.3f} deg between rays that no pose explains"
    if compared.shared:
        yield f"  in common    {', '.join(compared.shared)}: such errors do not show here"
    yield from map("  note         {}".format, compared.notes)
