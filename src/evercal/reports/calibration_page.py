"""The HTML report of `evercal report`: a calibration, its quality and its evidence."""

import math
import os
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.calibration.verdict import expected_error, verdict
from evercal.errors import InputError
from evercal.geometry import SE3, deviations, length_mm_deg
from evercal.reports.calibration_images import AnnotatedImages
from evercal.reports.calibration_tables import (
    camera_table,
    check_table,
    deviation_table,
    error_budget,
    has_uncertainty,
    level,
    source_table,
    suitability_table,
    use_table,
)
from evercal.reports.charts import Chart, Panel, Shape
from evercal.reports.overlay import origin_in_view
from evercal.reports.page import Picture, Tile, render
from evercal.reports.scene import (
    ABOVE,
    CHI2_95,
    Axes,
    Ellipsoid,
    Frustum,
    Surroundings,
    ellipse,
    readable_scale,
    view_panel,
)
from evercal.typing import Strings

_VIEW_PX = (420, 400)
"""Width and height of a view from above or from the side."""
_SIDE = (0, 2)
"""Axes of the view from the side."""
_ELLIPSOID = 0.015
"""Longest standard deviation as drawn, relative to the extent of a view: the ellipsoid of 95 % is
half as long as the camera."""
_BARS_PX = (850, 120)
"""Width and height of a chart of residuals."""


class NamedCalibration(NamedTuple):
    """A calibration and the name of its file."""

    name: str
    calibration: Calibration
    again: str = ""
    """What differs where it was made again."""


class CalibrationPage(NamedTuple):
    """A report."""

    html: str
    missing: Strings
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
            f"`against`: it is {old.mount} and the calibration is {new.mount}; give one of the"
            " same mount"
        )
    # For one lens; without intrinsics the frames are compared.
    with suppress(InputError):
        if new.camera is not None:
            old = old.for_lens(new.camera)
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
    board are drawn; the report states the standard deviation of `point_m` in the camera frame.
    """
    calibration = file.calibration
    missing = (*images.missing, *_missing(calibration))
    headline, _, details = (calibration.verdict or verdict(calibration)).partition(". ")
    deviations_of = None
    views = None
    if has_uncertainty(calibration):
        deviations_of = deviation_table(calibration, point_m)
        views = camera_views(calibration, images.surroundings)
    change = None
    same_map = False
    if older is not None:
        change = difference(calibration, older.calibration)
        digest = calibration.source.get("map")
        same_map = digest is not None
        same_map &= older.calibration.source.get("map") == digest
    html = render(
        "calibration.html",
        name=file.name,
        title=f"{file.name}: {calibration.parent_frame}_from_{calibration.child_frame}",
        calibration=calibration,
        parent=calibration.parent_frame,
        child=calibration.child_frame,
        level=level(calibration),
        headline=headline,
        details=details,
        first=_tiles(calibration),
        suitability=suitability_table(calibration),
        deviations=deviations_of,
        older=older,
        difference=change,
        same_map=same_map,
        images=images,
        origin=_origin(calibration),
        pictures=_pictures(images),
        landmarks_drawn=any(drawn.landmarks for drawn in images.images.values()),
        boards_drawn=boards,
        store=store,
        camera_views=views,
        budget=error_budget(calibration),
        camera=camera_table(calibration),
        residuals=residual_chart(calibration),
        uses=use_table(calibration),
        checks=check_table(calibration),
        source=source_table(file.name, calibration, file.again),
        missing=missing,
    )
    return CalibrationPage(html, missing)


def _pictures(images: AnnotatedImages) -> list[Picture]:
    pictures = []
    for name, drawn in images.images.items():
        caption = f"{os.path.basename(name)}: {drawn.summary}"
        pictures.append(Picture(drawn.image, caption))
    return pictures


def _tiles(calibration: Calibration) -> list[Tile]:
    """The expected error first, then what supports it."""
    tiles = []
    if level(calibration):
        mm, deg = expected_error(calibration)
        rule = "the larger of √3 standard deviations per axis and half the repeatability error"
        tiles = [
            Tile(f"{mm:.2f} mm", f"expected position error, at the target: {rule}"),
            Tile(f"{deg:.3f} deg", "expected rotation error, by the same rule"),
        ]
    if images := calibration.images:
        rejected = sum(not image.used for image in images)
        words = "images used"
        if rejected:
            words += f"; {rejected} rejected"
        tiles.append(Tile(f"{len(images) - rejected} of {len(images)}", words))
    halves = calibration.checks.repeatability_mm
    if halves is not None:
        words = "repeatability: difference between the positions from two halves of the data"
        tiles.append(Tile(f"{halves:.2f} mm", words))
    return tiles


def _origin(calibration: Calibration) -> str:
    if calibration.camera is None:
        return ""
    pose = calibration.parent_from_child.inverse()
    pixel, outside = origin_in_view(calibration.camera, pose)
    if outside:
        return f"lies {outside}"
    return f"projects to pixel ({pixel[0]:.1f}, {pixel[1]:.1f})"


def _missing(calibration: Calibration) -> list[str]:
    checks = calibration.checks
    split = (checks.repeatability_mm, checks.held_out_mm)
    parts = {
        "No uncertainty: the calibration states none.": has_uncertainty(calibration),
        "No list of images: the calibration holds none.": calibration.images,
        "No error budget: the calibration holds none.": calibration.error_terms,
        "No held-out error or repeatability: all data were used together.": split
        != (None, None),
        "No intrinsics: the calibration holds none.": calibration.camera,
    }
    return [sentence for sentence, part in parts.items() if not part]


def camera_views(calibration: Calibration, around: Surroundings) -> Chart:
    """Draw the camera and the ellipsoid of its position, from above and from the side."""
    pose = calibration.uncertain_pose
    parent = calibration.parent_frame
    ends = np.stack([np.zeros(3), pose.pose.translation_m])
    extent = float(np.ptp(around.bounds(ends), axis=0).max())
    times = readable_scale([Ellipsoid.of(pose)], _ELLIPSOID * extent)
    covariance = pose.covariance[:3, :3]
    variances, directions = np.linalg.eigh(covariance)
    half = times * np.sqrt(CHI2_95 * np.diag(covariance).clip(0))
    ellipsoid = [ends[1] - half, ends[1] + half]
    seen = np.concatenate([ends, ellipsoid])
    view = None
    if calibration.camera is not None:
        view = Frustum.of(pose.pose, calibration.camera)
    panels = []
    for plane in (ABOVE, _SIDE):
        shape = Shape("area", ellipse(pose, times, plane), "orange", opacity=0.3)
        axes = Axes(plane, parent)
        panels.append(
            view_panel(
                _VIEW_PX,
                axes,
                around,
                seen,
                view,
                [shape],
            )
        )
    c, b, a = 1000 * np.sqrt(CHI2_95 * variances.clip(0))
    forward = pose.pose.rotation_matrix()[:, 2]
    cosine = abs(directions[:, 2] @ forward)
    angle = np.rad2deg(np.arccos(np.clip(cosine, 0.0, 1.0)))
    caption = (
        f"In {parent}, from above and from the side. The 95 % ellipsoid of the position has half"
        f" axes of {a:.2f}, {b:.2f} and {c:.2f} mm and is drawn {times} times as large. The longest"
        f" one lies {angle:.0f} deg from the viewing direction."
    )
    return panels, caption


def residual_chart(calibration: Calibration) -> Chart | None:
    """Bars of the residuals of all images, cut at twice the largest used one; None without any."""
    images = calibration.images
    residuals = [[image.residual_mm, image.residual_deg] for image in images]
    rows = np.array(residuals, float).reshape(-1, 2)
    if not np.isfinite(rows).any():
        return None
    used = np.array([image.used for image in images])
    panels = []
    numbers = np.arange(1.0, len(images) + 1)
    end = max(len(images), 5) + 0.6
    width = 0.8 * _BARS_PX[0] / (end - 0.4)
    below = ("", "number of the image in the table")
    if not np.isfinite(rows[:, 1]).any():
        rows = rows[:, :1]
    for values, unit, label in zip(
        np.nan_to_num(rows).T, ("mm", "deg"), below[-rows.shape[1] :], strict=False
    ):
        typical = float(values[used].max(initial=0.0))
        highest = 1.1 * float(values.max())
        top = max(min(highest, 2 * typical or math.inf), 1e-3)
        ends = np.column_stack([numbers, values])
        bars = np.stack([ends, ends * (1, 0), ends * np.nan], axis=1)
        shapes = [
            Shape("line", bars[used].reshape(-1, 2), "blue", width),
            # Striped, so that the two kinds differ in grey print as well.
            Shape("stripes", bars[~used].reshape(-1, 2), "orange", width),
        ]
        limits = np.array([[0.4, 0.0], [end, top]])
        panels.append(Panel(_BARS_PX, limits, (label, f"residual ({unit})"), shapes))
    return (
        panels,
        "Residual of each image; rejected ones are striped, and cut where larger.",
    )
