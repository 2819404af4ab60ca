"""`evercal report`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, progress_bar
from evercal.cli.device import Device
from evercal.cli.image_words import image_files
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration
    from evercal.reports.calibration_comparison import Older
    from evercal.reports.calibration_page import Page, Subject
    from evercal.reports.calibration_views import Views


@dataclass(frozen=True)
class Report:
    """Write a page about a calibration: what it is good for, and the pictures that prove it."""

    calibration: Annotated[Positional[Path], arg(metavar="CALIBRATION.json")]
    """File of the calibration."""
    store: Annotated[Path | None, arg(metavar="STORE", help_behavior_hint="")] = None
    """Folder of the store: landmarks are found in the images and drawn with their residuals."""
    images: Annotated[tuple[Path, ...], arg(metavar="IMAGE...", help_behavior_hint="")] = ()
    """Images of the camera to draw into, or a folder of them; else those it was made from."""
    against: Annotated[Path | None, arg(metavar="OLD_CALIBRATION.json", help_behavior_hint="")] = (
        None
    )
    """An older calibration of the camera, to be compared with."""
    out: Annotated[Path, arg(metavar="FILE.html")] = Path("report.html")
    """Where the page is written; it holds all its pictures."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Writes the page."""
        if not self.out.absolute().parent.is_dir():
            raise InputError(f"--out {self.out}: its folder does not exist; make it first")
        from evercal.calibration.calibration import read_calibration
        from evercal.calibration.verdict import verdict
        from evercal.reports.calibration_page import Subject, calibration_page
        from evercal.storage import write_bytes

        found, older = read_calibration(self.calibration), self._older()
        store = None if self.store is None else str(self.store)
        views = self._views(found, older)
        subject = Subject(self.calibration.name, found, views, store, older)
        page = calibration_page(subject)
        write_bytes(self.out, page.html.encode())
        if self.json:
            print_json(_as_dict(self.out, subject, page))
            return 0
        print(found.verdict or verdict(found))
        for sentence in page.missing:
            print(f"  {sentence}")
        print(f"wrote {self.out}")
        print_next("evercal", "export", self.calibration, "--format", "easy_handeye2")
        return 0

    def _older(self) -> "Older | None":
        if self.against is None:
            return None
        from evercal.calibration.calibration import read_calibration
        from evercal.reports.calibration_comparison import Older

        return Older(self.against.name, read_calibration(self.against))

    def _views(self, found: "Calibration", older: "Older | None") -> "Views":
        from evercal.reports.calibration_views import Views, readable_images, views_of

        given = image_files(self.images) if self.images else []
        if found.camera is None:
            return views_of(found, [])
        files, none = readable_images(found, self.calibration.parent, given)
        if not files:
            return Views(missing=(none,))
        localizer = None
        if self.store is not None:
            from evercal.localization.localizer import Localizer

            localizer = Localizer.open(self.store, device=self.device)
        before = None if older is None else older.found
        with progress_bar("drawing", len(files), "image") as bar:
            return views_of(found, files, before, localizer, on_image=bar.update)


def _as_dict(out: Path, subject: "Subject", page: "Page") -> dict[str, object]:
    """The report as JSON values."""
    from evercal.calibration.verdict import expected_error, tier, verdict
    from evercal.reports.calibration_comparison import difference

    found, good = subject.found, tier(subject.found)
    millimetres, degrees = expected_error(found)
    against = None
    if subject.older is not None:
        apart = difference(found, subject.older.found)
        against = {"translation_mm": apart[0], "rotation_deg": apart[1]}
    return {
        "report": str(out),
        "verdict": found.verdict or verdict(found),
        "tier": None if good is None else good.name,
        "expected_error_mm": millimetres,
        "expected_error_deg": degrees,
        "pictures": [view.name for view in subject.views.views],
        "against": against,
        "missing": list(page.missing),
    }
