"""`evercal report`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.arguments import open_localizer, point_dict, point_of, point_text
from evercal.cli.console import progress_bar, require_writable
from evercal.cli.options import At, Device, Verb

if TYPE_CHECKING:
    from evercal.reports.calibration_images import AnnotatedImages, BoardSeen
    from evercal.reports.calibration_page import NamedCalibration


@dataclass(frozen=True)
class Report(Verb):
    """Write an HTML report of a calibration: verdict, uncertainty, residuals and overlays.

    Example: evercal report tripod.json --store cell.evercal
    """

    calibration: Annotated[Positional[Path], arg(metavar="CALIBRATION.json")]
    """Calibration file, or a map that was learned from gripper poses (MAP or MAP:SCENE)."""
    store: Annotated[Path | None, arg(metavar="MAP", help_behavior_hint="")] = None
    """Folder of the store. Its landmarks are drawn with their residuals."""
    images: Annotated[
        tuple[Path, ...],
        arg(metavar="IMAGE...", help_behavior_hint="(default: images of the calibration)"),
    ] = ()
    """Images of the camera, or a folder of them."""
    against: Annotated[Path | None, arg(metavar="OLD.json", help_behavior_hint="")] = None
    """Older calibration of the same camera, to compare with."""
    at: At = None
    out: Annotated[Path, arg(metavar="FILE.html")] = Path("report.html")
    """The report, one file including its pictures."""
    device: Device = "auto"

    def run(self) -> int:
        require_writable(self.out, "--out")
        point = point_of(self.at)
        from evercal.calibration.calibration import read_calibration
        from evercal.calibration.learned import calibration_at
        from evercal.calibration.verdict import expected_error, tier, verdict
        from evercal.reports.calibration_images import boards_seen
        from evercal.reports.calibration_page import NamedCalibration, calibration_page, difference
        from evercal.storage import write_bytes

        calibration = calibration_at(self.calibration)
        older = None
        if self.against is not None:
            older = NamedCalibration(self.against.name, read_calibration(self.against))
        file = NamedCalibration(self.calibration.name, calibration)
        boards = boards_seen(calibration, self.calibration.parent)
        images = self._images(file, older, boards)
        store = None if self.store is None else str(self.store)
        page = calibration_page(file, images, store, older, point, bool(boards))
        write_bytes(self.out, page.html.encode())
        text = calibration.verdict or verdict(calibration)
        words = [] if point is None else [point_text(point, calibration.uncertain_pose)]
        lines = [text, *(f"  {line}" for line in (*words, *page.missing)), f"wrote {self.out}"]
        against = None
        if older is not None:
            change = difference(calibration, older.calibration)
            against = {"translation_mm": change.mm, "rotation_deg": change.deg}
        best, (mm, deg) = tier(calibration), expected_error(calibration)
        record = {
            "report": str(self.out),
            "verdict": text,
            "tier": None if best is None else best.name,
            "expected_error_mm": mm,
            "expected_error_deg": deg,
            "pictures": list(images.images),
            "against": against,
            "missing": list(page.missing),
            **({} if point is None else {"at": point_dict(point, calibration.uncertain_pose)}),
        }
        then = ("export", self.calibration, "--format", "easy_handeye2")
        return self.answer(record, lines, then)

    def _images(
        self,
        file: "NamedCalibration",
        older: "NamedCalibration | None",
        boards: "dict[str, BoardSeen]",
    ) -> "AnnotatedImages":
        from evercal.recordings.image_files import image_files
        from evercal.reports.calibration_images import annotate_images, select_images

        calibration = file.calibration
        given = image_files(self.images) if self.images else []
        if calibration.camera is None:
            return annotate_images(calibration, [])
        files, reason = select_images(calibration, self.calibration.parent, given)
        localizer = None
        if self.store is not None:
            localizer = open_localizer(self.store, self.device)
        before = None if older is None else older.calibration
        if not files:
            nothing = annotate_images(calibration, [], before, localizer, boards)
            return replace(nothing, missing=(reason,))
        with progress_bar("drawing", len(files), "image") as bar:
            return annotate_images(calibration, files, before, localizer, boards, bar.update)
