"""Exports and reports of the calibrations."""

from pathlib import Path
from typing import Any

from evercal.calibration.calibration import Calibration
from evercal.calibration.export.formats import export_files
from evercal.localization.localizer import Localizer
from evercal.recordings.image_files import image_files
from evercal.reports.calibration_images import (
    AnnotatedImages,
    annotate_images,
    select_images,
)
from evercal.reports.calibration_page import NamedCalibration, calibration_page
from evercal.service.studio.devices import Which
from evercal.service.studio.folders import Folders, needs_robot_poses
from evercal.storage import write_bytes


def export(
    folders: Folders, which: Which, calibration: Calibration, format: str
) -> tuple[Path, ...]:
    """Write a calibration in a format of other programs and return the files.

    Raises:
        InputError: The format needs something that the studio does not have.
    """
    path = folders.export(which, format)
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {}
    if needs_robot_poses(which, format):
        options["robot_poses"] = folders.wrist / "base_from_gripper.csv"
    return export_files(calibration, format, path, **options).files


def report(
    folders: Folders, which: Which, calibration: Calibration, localizer: Localizer | None
) -> Path:
    """Write the HTML report of a calibration with landmarks in some of its images."""
    given = image_files([folders.wrist / "images"]) if which == "wrist" else []
    files, reason = select_images(calibration, folders.out, given)
    images = AnnotatedImages(missing=(reason,))
    if files:
        images = annotate_images(calibration, files, None, localizer)
    named = NamedCalibration(folders.calibration(which).name, calibration)
    page = calibration_page(named, images, str(folders.map))
    write_bytes(folders.report(which), page.html.encode())
    return folders.report(which)
