"""The HTML report of `evercal report`: a calibration, its quality and its evidence."""

import json
import math
import os
from typing import Literal, NamedTuple

import numpy as np

from evercal.calibration.calibration import Calibration, position_shares
from evercal.calibration.located import deviations, length_mm_deg
from evercal.calibration.verdict import TIERS, expected_error, tier, verdict
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.geometry.camera import COEFFICIENTS
from evercal.reports.calibration_images import AnnotatedImages
from evercal.reports.charts import Chart, Panel, Shape
from evercal.reports.overlay import origin_in_view
from evercal.reports.page import Picture, Table, Tile, render
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

_SHOWN_ELSEWHERE = ("warnings", "left_open", "camera_sigma", "joints_move_mm")
_LONGEST_CELL = 160
_VIEW_PX = (420, 400)
_BARS_PX = (850, 120)


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
            f"`against`: it is {old.mount} and the calibration is {new.mount}; give one of the"
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
    board are drawn; the report states the standard deviation of `point_m` in the camera frame.
    """
    calibration = file.calibration
    missing = (*images.missing, *_missing(calibration))
    headline, _, details = (calibration.verdict or verdict(calibration)).partition(". ")
    old = None if older is None else older.calibration
    uncertain = _has_uncertainty(calibration)
    own_map = calibration.source.get("map")
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
        suitability=suitability_table(calibration),
        deviations=deviation_table(calibration, point_m) if uncertain else None,
        older=older,
        difference=None if old is None else difference(calibration, old),
        same_map=old is not None
        and own_map is not None
        and old.source.get("map") == own_map,
        images=images,
        origin=_origin(calibration),
        pictures=[
            Picture(drawn.image, f"{os.path.basename(name)}: {drawn.summary}")
            for name, drawn in images.images.items()
        ],
        landmarks_drawn=any(drawn.landmarks for drawn in images.images.values()),
        boards_drawn=boards,
        store=store,
        camera_views=camera_views(calibration, images.surroundings)
        if uncertain
        else None,
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
    if not _has_uncertainty(calibration) and not calibration.checks.to_dict():
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
    halves = calibration.checks.repeatability_mm
    if halves is not None:
        words = "repeatability: difference between the positions from two halves of the data"
        tiles.append(Tile(f"{halves:.2f} mm", words))
    return tiles


def suitability_table(calibration: Calibration) -> Table:
    """The uses that a calibration serves."""
    known = _level(calibration)
    best = tier(calibration)
    serves = ["yes" if known and best and t.mm >= best.mm else "no" for t in TIERS]
    rows = [
        (t.name, f"{t.mm:g}", f"{t.deg:g}", word)
        for t, word in zip(TIERS, serves, strict=True)
    ]
    header = (
        "use",
        "position error below (mm)",
        "rotation error below (deg)",
        "suitable",
    )
    return Table(
        header, rows, "A use is suitable if both expected errors lie below its bounds."
    )


def _origin(calibration: Calibration) -> str:
    if calibration.camera is None:
        return ""
    pose = calibration.parent_from_child.inverse()
    pixel, outside = origin_in_view(calibration.camera, pose)
    return (
        f"lies {outside}"
        if outside
        else f"projects to pixel ({pixel[0]:.1f}, {pixel[1]:.1f})"
    )


def _missing(calibration: Calibration) -> list[str]:
    checks = calibration.checks
    gaps = {
        "No uncertainty: the calibration states none.": _has_uncertainty(calibration),
        "No list of images: the calibration holds none.": calibration.images,
        "No error budget: the calibration holds none.": calibration.error_terms,
        "No repeatability: two halves of the data were not compared.": checks.repeatability_mm
        is not None,
        "No held-out error: no data were held out.": checks.held_out_mm is not None,
        "No intrinsics: the calibration holds none.": calibration.camera,
    }
    return [sentence for sentence, present in gaps.items() if not present]


def _has_uncertainty(calibration: Calibration) -> bool:
    return bool(np.trace(calibration.covariance) > 0)


def deviation_table(
    calibration: Calibration, point_m: tuple[float, float, float] | None = None
) -> Table:
    """Standard deviations along axes: of the position, the rotation, and a point if given."""
    parent = calibration.parent_frame
    child = calibration.child_frame
    uncertain = calibration.uncertain_pose
    sigma = np.sqrt(np.diag(calibration.covariance).clip(0))
    position = [*(1000 * sigma[:3]), calibration.sigma_mm]
    rotation = [*np.rad2deg(sigma[3:]), calibration.sigma_deg]
    rows = [
        (f"position along the axes of {parent} (mm)", *(f"{v:.3f}" for v in position)),
        (f"rotation about the axes of {child} (deg)", *(f"{v:.4f}" for v in rotation)),
    ]
    if point_m is not None:
        axes = 1000 * np.sqrt(np.diag(uncertain.point_covariance(point_m)).clip(0))
        point = ", ".join(f"{value:g}" for value in point_m)
        name = f"point ({point}) m of {child} along the axes of {parent} (mm)"
        rows.append(
            (name, *(f"{v:.3f}" for v in (*axes, uncertain.point_sigma_mm(point_m))))
        )
    return Table(("", "x", "y", "z", "root mean square"), rows, "Standard deviations")


def error_budget(calibration: Calibration) -> Table:
    """The causes of the uncertainty and their sum."""
    terms = calibration.error_terms
    rows = [
        (
            term.name,
            f"{term.translation_mm:.2f}",
            f"{term.rotation_deg:.3f}",
            f"{100 * share:.0f}",
        )
        for term, share in zip(terms, position_shares(terms), strict=True)
    ]
    if rows:
        total = f"{calibration.sigma_mm:.2f}", f"{calibration.sigma_deg:.3f}"
        rows.append(("all", *total, "100"))
    header = (
        "cause",
        "position (mm)",
        "rotation (deg)",
        "share of the position's variance (%)",
    )
    return Table(header, rows, "Error budget: standard deviation per axis by cause")


def use_table(calibration: Calibration) -> Table:
    """All images with their use; those of boards with what they contribute."""
    images = calibration.images
    checks = calibration.checks
    folders = {image.name[: image.name.rfind("/") + 1] for image in images}
    folder = folders.pop() if len(folders) == 1 else ""
    share = checks.information_percent or {}
    moved = checks.leave_one_out_mm or {}
    rows = [
        (
            image.name.removeprefix(folder),
            "yes" if image.used else "no",
            image.reason,
            _fixed(image.residual_mm, 2),
            _fixed(image.residual_deg, 3),
            _fixed(share.get(image.name), 1),
            _fixed(moved.get(image.name), 3),
        )
        for image in images
    ]
    measures = (
        "residual (mm)",
        "residual (deg)",
        "information (%)",
        "moves position by (mm)",
    )
    used = sum(image.used for image in images)
    caption = f"{used} of {len(images)} images used" + (
        f", all in {folder}" if folder else ""
    )
    return Table(("name", "used", "reason", *measures), rows, caption)


def camera_table(calibration: Calibration) -> Table:
    """The intrinsics, with standard deviations where they were estimated."""
    camera = calibration.camera
    rows = []
    if camera is not None:
        sigma = calibration.checks.camera_sigma or {}
        values = {
            f"{name} (px)": getattr(camera, name) for name in ("fx", "fy", "cx", "cy")
        }
        values |= dict(zip(COEFFICIENTS[camera.model], camera.distortion, strict=False))
        rows = [
            (name, f"{value:.4f}", _fixed(sigma.get(name.partition(" ")[0]), 4))
            for name, value in values.items()
        ]
        rows.insert(0, ("image size (px)", f"{camera.width}x{camera.height}", "-"))
    return Table(("intrinsics", "value", "standard deviation"), rows)


def check_table(calibration: Calibration) -> Table:
    """The checks that were made and other values estimated with the transform."""
    rows = [
        (key.replace("_", " "), _cell(value))
        for key, value in calibration.checks.to_dict().items()
        if key not in _SHOWN_ELSEWHERE and len(_cell(value)) <= _LONGEST_CELL
    ]
    return Table(("check", "value"), rows)


def source_table(name: str, calibration: Calibration) -> Table:
    """What the calibration was made from."""
    source = {"file": name, **calibration.source, "created": calibration.created}
    rows = [
        (key.replace("_", " "), _cell(value)) for key, value in source.items() if value
    ]
    return Table(("property", "value"), rows)


def _cell(value: object) -> str:
    if isinstance(value, str):
        return value
    return f"{value:.6g}" if isinstance(value, float) else json.dumps(value)


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def camera_views(calibration: Calibration, around: Surroundings) -> Chart:
    """Draw the camera and the ellipsoid of its position, from above and from the side."""
    pose = calibration.uncertain_pose
    parent = calibration.parent_frame
    ends = np.stack([np.zeros(3), pose.pose.translation_m])
    extent = float(np.ptp(around.bounds(ends), axis=0).max())
    times = readable_scale([Ellipsoid.of(pose)], 0.07 * extent)
    variances, directions = np.linalg.eigh(pose.covariance[:3, :3])
    half = times * np.sqrt(CHI2_95 * np.diag(pose.covariance)[:3].clip(0))
    seen = np.concatenate([ends, [ends[1] - half, ends[1] + half]])
    width, depth, _ = np.ptp(around.bounds(seen), axis=0)
    camera = calibration.camera
    panels = []
    view = None if camera is None else Frustum.of(pose.pose, camera)
    for plane in (ABOVE, (int(depth > width), 2)):  # from the wider side
        shape = Shape("area", ellipse(pose, times, plane), "orange", opacity=0.3)
        axes = Axes(plane, parent)
        panels.append(view_panel(_VIEW_PX, axes, around, seen, view, [shape]))
    c, b, a = 1000 * np.sqrt(CHI2_95 * variances.clip(0))
    forward = pose.pose.rotation_matrix()[:, 2]
    angle = np.rad2deg(np.arccos(np.clip(abs(directions[:, 2] @ forward), 0.0, 1.0)))
    caption = (
        f"In {parent}, from above and from the side. The 95 % ellipsoid of the position has half"
        f" axes of {a:.2f}, {b:.2f} and {c:.2f} mm and is drawn {times} times as large. The longest"
        f" one lies {angle:.0f} deg from the viewing direction."
    )
    return panels, caption


def residual_chart(calibration: Calibration) -> Chart | None:
    """Bars of the residuals of all images, cut at twice the largest used one; None without any."""
    images = calibration.images
    rows = np.array(
        [[i.residual_mm, i.residual_deg] for i in images], np.float64
    ).reshape(-1, 2)
    if not np.isfinite(rows).any():
        return None
    used = np.array([image.used for image in images])
    panels = []
    numbers = np.arange(1.0, len(images) + 1)
    end = max(len(images), 5) + 0.6
    width = 0.8 * _BARS_PX[0] / (end - 0.4)
    below = "number of the image in the table"
    for values, unit, label in zip(
        np.nan_to_num(rows).T, ("mm", "deg"), ("", below), strict=True
    ):
        typical = float(values[used].max(initial=0.0))
        top = max(min(1.1 * float(values.max()), 2 * typical or math.inf), 1e-3)
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
