"""The HTML report of `evercal report`: a calibration, its quality and its evidence."""

import os
from typing import Literal, NamedTuple

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.calibration.located import deviations, length_mm_deg
from evercal.calibration.verdict import TIERS, expected_error, tier, verdict
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.reports.calibration_charts import camera_views, residual_chart
from evercal.reports.calibration_images import AnnotatedImages
from evercal.reports.calibration_tables import (
    camera_table,
    check_table,
    deviation_table,
    error_budget,
    source_table,
    use_table,
)
from evercal.reports.overlay import origin_in_view
from evercal.reports.page import Picture, Tile, render


class NamedCalibration(NamedTuple):
    """A calibration and the name of its file."""

    name: str
    calibration: Calibration


class CalibrationPage(NamedTuple):
    """A report."""

    html: str
    missing: tuple[str, ...]
    """Sentences about contents that the calibration does not provide."""


class Difference(NamedTuple):
    """Difference between two calibrations of one camera."""

    mm: float
    """Distance between the positions."""
    deg: float
    """Angle between the orientations."""
    offset_mm: tuple[float, float, float]
    """New position minus old position in the parent frame."""


def difference(new: Calibration, old: Calibration) -> Difference:
    """Compare two calibrations of one camera."""
    if new.mount != old.mount:
        raise InputError(
            f"--against: it is {old.mount} and the calibration is {new.mount}; give one of the"
            " same mount"
        )
    offset = deviations(SE3.stack([new.parent_from_child]), old.parent_from_child)[0]
    x, y, z = (1000 * offset[:3]).tolist()
    return Difference(*length_mm_deg(offset), (x, y, z))


def calibration_page(
    file: NamedCalibration,
    images: AnnotatedImages,
    store: str | None = None,
    older: NamedCalibration | None = None,
    point_m: tuple[float, float, float] | None = None,
    boards: bool = False,
) -> CalibrationPage:
    """Write the report of a calibration.

    `store` is the path of the store whose landmarks are drawn; `boards` says whether corners of a
    board are drawn. `point_m` is a point in the camera
    frame, metres, whose standard deviation is reported.
    """
    calibration = file.calibration
    missing = (*images.missing, *_missing(calibration))
    headline, _, details = (calibration.verdict or verdict(calibration)).partition(". ")
    old = None if older is None else older.calibration
    uncertain = _has_uncertainty(calibration)
    html = render(
        "calibration.html",
        title=f"{file.name}: {calibration.parent_frame}_from_{calibration.child_frame}",
        calibration=calibration,
        parent=calibration.parent_frame,
        child=calibration.child_frame,
        level=_level(calibration),
        headline=headline,
        details=details,
        first=_tiles(calibration),
        tiers=TIERS,
        best=tier(calibration),
        deviations=deviation_table(calibration, point_m) if uncertain else None,
        older=older,
        difference=None if old is None else difference(calibration, old),
        same_map=old is not None and _map(old) is not None and _map(old) == _map(calibration),
        images=images,
        origin=_origin(calibration),
        pictures=[
            Picture.photo(drawn.image, f"{os.path.basename(name)}: {drawn.summary}")
            for name, drawn in images.images.items()
        ],
        landmarks_drawn=any(drawn.landmarks for drawn in images.images.values()),
        boards_drawn=boards,
        store=store,
        camera_views=camera_views(calibration, images.surroundings) if uncertain else None,
        budget=error_budget(calibration),
        camera=camera_table(calibration),
        residuals=residual_chart(calibration),
        uses=use_table(calibration),
        checks=check_table(calibration),
        source=source_table(file.name, calibration),
        missing=missing,
    )
    return CalibrationPage(html, missing)


def _level(calibration: Calibration) -> Literal["good", "fair", "bad", ""]:
    if not _has_uncertainty(calibration) and not calibration.checks:
        return ""
    best = tier(calibration)
    return "bad" if best is None else "fair" if best is TIERS[-1] else "good"


def _tiles(calibration: Calibration) -> list[Tile]:
    """The expected error first, then what supports it."""
    tiles = []
    if _level(calibration):
        mm, deg = expected_error(calibration)
        rule = "the larger of √3 standard deviations per axis and half the repeatability error"
        tiles = [
            Tile(f"{mm:.2f} mm", f"expected position error, at the target: {rule}"),
            Tile(f"{deg:.3f} deg", "expected rotation error, by the same rule"),
        ]
    if images := calibration.images:
        rejected = sum(not image.used for image in images)
        words = f"images used; {rejected} rejected" if rejected else "images used"
        tiles.append(Tile(f"{len(images) - rejected} of {len(images)}", words))
    halves = calibration.checks.get("repeatability_mm")
    if halves is not None:
        words = "repeatability: difference between the positions from two halves of the data"
        tiles.append(Tile(f"{halves:.2f} mm", words))
    return tiles


def _origin(calibration: Calibration) -> str:
    if calibration.camera is None:
        return ""
    pose = calibration.parent_from_child.inverse()
    pixel, outside = origin_in_view(calibration.camera, pose)
    return f"lies {outside}" if outside else f"projects to pixel ({pixel[0]:.1f}, {pixel[1]:.1f})"


def _map(calibration: Calibration) -> object:
    return calibration.source.get("map")


def _missing(calibration: Calibration) -> list[str]:
    checks = calibration.checks
    gaps = {
        "No uncertainty: the calibration states none.": _has_uncertainty(calibration),
        "No list of images: the calibration holds none.": calibration.images,
        "No error budget: the calibration holds none.": calibration.error_terms,
        "No repeatability: two halves of the data were not compared.": "repeatability_mm" in checks,
        "No held-out error: no data were held out.": "held_out_mm" in checks,
        "No intrinsics: the calibration holds none.": calibration.camera,
    }
    return [sentence for sentence, present in gaps.items() if not present]


def _has_uncertainty(calibration: Calibration) -> bool:
    return bool(np.trace(calibration.covariance) > 0)
