"""`evercal report`."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.again import made_again
from evercal.cli.console import require_writable
from evercal.progress import progress_bar

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration
    from evercal.reports.calibration_images import AnnotatedImages, BoardSeen


@frozen
class Report(args.Verb):
    """Write an HTML report of a calibration: residuals and overlays.

    Example: evercal report tripod.json --store cell.evercal
    """

    calibration: Annotated[Positional[Path], arg(metavar="CALIBRATION.json")]
    """Calibration file, or a map that was learned from gripper poses (MAP or MAP:SCENE)."""
    store: Annotated[Path | None, args.shown("MAP")] = None
    """Folder of the map. Its landmarks are drawn with their residuals."""
    images: Annotated[
        tuple[Path, ...], args.shown("IMAGE...", "(default: those of the calibration)")
    ] = ()
    """Images of the camera, or a folder of them."""
    against: Annotated[Path | None, args.shown("OLD.json")] = None
    """Older calibration of the same camera, to compare with."""
    again: bool = False
    """Make the calibration again with the recorded command: what differs, and by how much."""
    at: args.At = None
    out: Annotated[Path, arg(metavar="FILE.html")] = Path("report.html")
    """The report, one file including its pictures."""

    def run(self) -> int:
        require_writable(self.out, "--out")
        point = args.Point.parse(self.at)
        from evercal.calibration.calibration import read_calibration
        from evercal.calibration.learned import calibration_at
        from evercal.calibration.verdict import expected_error, tier, verdict
        from evercal.reports.calibration_images import boards_seen
        from evercal.reports.calibration_page import (
            NamedCalibration,
            calibration_page,
            difference,
        )
        from evercal.storage import write_bytes

        calibration = calibration_at(self.calibration)
        older = None
        if self.against is not None:
            older = NamedCalibration(self.against.name, read_calibration(self.against))
        boards = boards_seen(calibration, self.calibration.parent)
        images = self._images(calibration, older and older.calibration, boards)
        again = ""
        if self.again:
            again = made_again(self.calibration, calibration)
        page = calibration_page(
            NamedCalibration(self.calibration.name, calibration, again),
            images,
            self.store and str(self.store),
            older,
            point,
            bool(boards),
        )
        write_bytes(self.out, page.html.encode())
        best = tier(calibration)
        mm, deg = expected_error(calibration)
        sentence = calibration.verdict or verdict(calibration)
        record: dict[str, object] = {
            "report": str(self.out),
            "verdict": sentence,
            "tier": best and best.name,
            "expected_error_mm": mm,
            "expected_error_deg": deg,
            "pictures": list(images.images),
            "against": None,
            "missing": list(page.missing),
            "again": again,
        }
        if older is not None:
            change = difference(calibration, older.calibration)
            sizes = {"translation_mm": change.mm, "rotation_deg": change.deg}
            record["against"] = sizes
        lines = [sentence]
        if point is not None:
            record["at"] = point.record(calibration.uncertain_pose)
            lines.append(f"  {point.text(calibration.uncertain_pose)}")
        if again:
            lines.append(f"  {again}")
        lines += map("  {}".format, page.missing)
        then = args.next_words(calibration, self.calibration)
        self.answer(record, *lines, f"wrote {self.out}", then=then)
        return 0

    def _images(
        self,
        calibration: "Calibration",
        older: "Calibration | None",
        boards: "dict[str, BoardSeen]",
    ) -> "AnnotatedImages":
        from evercal.recordings.image_files import image_files
        from evercal.reports.calibration_images import annotate_images, select_images

        given = image_files(self.images) if self.images else []
        if calibration.camera is None:
            return annotate_images(calibration, [])
        files, reason = select_images(calibration, self.calibration.parent, given)
        localizer = self.store and args.open_localizer(self.store)
        with progress_bar("drawing", len(files), "image") as bar:
            drawn = annotate_images(
                calibration, files, older, localizer, boards, bar.update
            )
        return drawn if files else replace(drawn, missing=(reason,))
