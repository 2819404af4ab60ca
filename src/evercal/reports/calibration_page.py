"""The HTML report of `evercal report`: a calibration, its quality and its evidence."""

import json
import math
import os
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.calibration.located import deviations, length_mm_deg
from evercal.calibration.verdict import TIERS, expected_error, tier, verdict
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.reports.board_views import BoardSeen, board_scene, contributions, estimates
from evercal.reports.calibration_charts import ellipsoid_projections, error_terms, residual_bars
from evercal.reports.calibration_images import AnnotatedImages
from evercal.reports.overlay import encode_image
from evercal.reports.page import Picture, Table, Tile, render
from evercal.reports.scene.side_views import calibrated_views

_CHECKS = {
    "repeatability": "difference between two halves of the data",
    "held_out": "error on held-out data",
}
_SHOWN_ELSEWHERE = {
    "image_scatter",
    "warnings",
    "left_open",
    "camera_sigma",
    "scale",
    "scale_sigma",
    "corner_sigma_px",
    "time_offset_s",
    "time_offset_sigma_s",
}
"""Checks with a place of their own in the report."""
_LONGEST_CELL = 160
_SHARE = 0.95


class NamedCalibration(NamedTuple):
    """A calibration and the name of its file."""

    name: str
    calibration: Calibration


@dataclass(frozen=True)
class CalibrationPage:
    """A report."""

    html: str
    """The HTML document."""
    missing: tuple[str, ...]
    """Sentences about contents that the calibration does not provide."""


@dataclass(frozen=True)
class Difference:
    """Difference between two calibrations of one camera."""

    mm: float
    """Distance between the positions."""
    deg: float
    """Angle between the orientations."""
    offset_mm: tuple[float, float, float]
    """New position minus old position in the parent frame."""


def difference(new: Calibration, old: Calibration) -> Difference:
    """Compare two calibrations of one camera.

    Raises:
        InputError: One camera is fixed, the other is mounted on the gripper.
    """
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
    boards: dict[str, BoardSeen] | None = None,
) -> CalibrationPage:
    """Write the report of a calibration.

    `boards` are the boards in its images, which are drawn with the cameras in the base frame.
    `store` is the path of the store whose landmarks are drawn. `point_m` is a point in the camera
    frame, metres, whose standard deviation is reported.

    Raises:
        InputError: A check of the calibration is not a number, or `older` has another mount.
    """
    calibration = file.calibration
    checks = Table(("check", "mm", "deg"), _check_rows(calibration))
    missing = (*images.missing, *_missing(calibration))
    text = calibration.verdict or verdict(calibration)
    headline, _, details = text.partition(". ")
    sigma = np.sqrt(np.clip(np.diag(calibration.covariance), 0.0, None))
    board_drawn = board_scene(calibration, boards) if boards else None
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
        matrix=calibration.parent_from_child.matrix(),
        uncertain=_has_uncertainty(calibration),
        sigma_mm=1000 * sigma[:3],
        sigma_deg=np.rad2deg(sigma[3:]),
        point=None if point_m is None else _point(calibration, point_m),
        older=older,
        difference=None if older is None else difference(calibration, older.calibration),
        pixel_shift=_pixel_shift(images),
        same_map=older is not None and _same_map(calibration, older.calibration),
        views=_views(calibration, images) if board_drawn is None else [],
        pictures=_pictures(images, calibration.parent_frame),
        images=images,
        boards_drawn=bool(boards),
        store=store,
        board_scene=board_drawn,
        **_evidence(calibration),
        checks=checks,
        source=Table(("property", "value"), _source_rows(file)),
        missing=missing,
    )
    return CalibrationPage(html, missing)


def _evidence(calibration: Calibration) -> dict[str, Picture | Table | None]:
    """What the template shows of the images and the uncertainty; None where it is not known."""
    return {
        "residuals": _residuals(calibration),
        "uses": _use_table(calibration),
        "ellipsoid": _ellipsoid(calibration) if _has_uncertainty(calibration) else None,
        "terms": _terms(calibration),
        "estimates": estimates(calibration),
        "contributions": contributions(calibration),
    }


def _level(calibration: Calibration) -> Literal["good", "fair", "bad", ""]:
    """Colour of the verdict; empty without any measure of quality."""
    if not _has_uncertainty(calibration) and not _check_rows(calibration):
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
        used = sum(image.used for image in images)
        tiles.append(Tile(f"{used} of {len(images)}", "images used; the others were rejected"))
    halves = _check_value(calibration, "repeatability_mm")
    if halves is not None:
        words = "repeatability: difference between the positions from two halves of the data"
        tiles.append(Tile(f"{halves:.2f} mm", words))
    return tiles


def _views(calibration: Calibration, images: AnnotatedImages) -> list[Picture]:
    drawn, scale = calibrated_views(calibration, images.surroundings)
    captions = (f"From above: x and y of {calibration.parent_frame}; {scale}", "From the side")
    return [Picture(data, caption) for data, caption in zip(drawn, captions, strict=False)]


class _Point(NamedTuple):
    """A point in the camera frame and its error in the parent frame."""

    name: str
    sigma_mm: list[float]
    """Along the axes of the parent."""
    rms_mm: float


def _point(calibration: Calibration, point_m: tuple[float, float, float]) -> _Point:
    uncertain = calibration.uncertain_pose
    variance = np.maximum(np.diag(uncertain.point_covariance(point_m)), 0.0)
    name = ", ".join(f"{value:g}" for value in point_m)
    sigma = (1000 * np.sqrt(variance)).tolist()
    return _Point(f"({name}) m", sigma, uncertain.point_sigma_mm(point_m))


def _pixel_shift(images: AnnotatedImages) -> float | None:
    """Distance in the image between the origins of both calibrations, pixels."""
    if images.axes is None or images.older_axes is None or images.axes.outside:
        return None
    pixels = float(np.linalg.norm(images.axes.origin_px - images.older_axes.origin_px))
    return pixels if math.isfinite(pixels) else None


def _same_map(new: Calibration, old: Calibration) -> bool:
    return new.source.get("map") is not None and new.source.get("map") == old.source.get("map")


def _pictures(images: AnnotatedImages, parent: str) -> list[Picture]:
    pictures = [
        Picture(encode_image(item.image, "jpg"), f"{os.path.basename(item.name)}: {item.summary}")
        for item in images.images
    ]
    if images.close_up is not None:
        caption = f"The origin of {parent} in the first image, enlarged"
        pictures.append(Picture(encode_image(images.close_up, "jpg"), caption))
    return pictures


def _use_table(calibration: Calibration) -> Table | None:
    images = calibration.images
    if not images:
        return None
    folders = {image.name[: image.name.rfind("/") + 1] for image in images}
    folder = folders.pop() if len(folders) == 1 else ""
    used = sum(image.used for image in images)
    caption = f"{used} of {len(images)} images used" + (f", all in {folder}" if folder else "")
    rows = [replace(image, name=image.name.removeprefix(folder)) for image in images]
    return Table.of_records(rows, caption)


def _residuals(calibration: Calibration) -> Picture | None:
    images = calibration.images
    if not _has_residuals(calibration):
        return None
    bars = residual_bars(
        [image.residual_mm for image in images],
        [image.residual_deg for image in images],
        [image.used for image in images],
    )
    return Picture(bars, "Residual of each image")


def _ellipsoid(calibration: Calibration) -> Picture:
    from scipy import stats

    covariance = calibration.covariance[:3, :3]
    values, vectors = np.linalg.eigh(covariance)
    c, b, a = 1000 * np.sqrt(stats.chi2.ppf(_SHARE, 3) * np.clip(values, 0.0, None))
    longest = vectors[:, 2] * np.sign(vectors[np.argmax(np.abs(vectors[:, 2])), 2])
    x, y, z = longest + 0.0  # no negative zeros
    forward = calibration.parent_from_child.rotation_matrix()[:, 2]
    angle = np.rad2deg(np.arccos(np.clip(abs(longest @ forward), 0.0, 1.0)))
    frame = calibration.parent_frame
    caption = (
        f"95 % ellipsoid of the position, seen along each axis of {frame}. Its half axes are"
        f" {a:.2f}, {b:.2f} and {c:.2f} mm. The longest one points along ({x:.2f}, {y:.2f},"
        f" {z:.2f}) of {frame}, {angle:.0f} deg from the viewing direction of the camera."
    )
    return Picture(ellipsoid_projections(1e6 * covariance, frame, _SHARE), caption)


def _terms(calibration: Calibration) -> Picture | None:
    terms = calibration.error_terms
    if not terms:
        return None
    chart = error_terms(
        [*(term.name for term in terms), "total"],
        [*(term.translation_mm for term in terms), calibration.sigma_mm],
        [*(term.rotation_deg for term in terms), calibration.sigma_deg],
    )
    return Picture(chart, "Error budget: " + "; ".join(term.name for term in terms))


def _check_rows(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Rows of the checks that were made: name, millimetres, degrees."""
    rows = []
    for key, title in _CHECKS.items():
        mm, deg = (_check_value(calibration, f"{key}_{unit}") for unit in ("mm", "deg"))
        if mm is not None or deg is not None:
            rows.append((title, _fixed(mm, 2), _fixed(deg, 3)))
    scatter = _scatter(calibration.checks.get("image_scatter"))
    if scatter is not None:
        mm, deg = scatter
        rows.append(("scatter of single images, per axis", _fixed(mm, 2), _fixed(deg, 3)))
    return rows


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _check_value(calibration: Calibration, key: str) -> float | None:
    value = calibration.checks.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f"checks.{key} of the calibration is {value!r}; give a number or omit it")
    return float(value)


def _scatter(value: object) -> tuple[float, float] | None:
    """Millimetres and degrees per axis from a (6, 6) scatter matrix."""
    try:
        diagonal = np.diag(np.array(value, dtype=np.float64))
    except (TypeError, ValueError):
        return None
    if diagonal.shape != (6,) or not (diagonal >= 0).all():
        return None
    metres, radians = np.sqrt(diagonal[:3].mean()), np.sqrt(diagonal[3:].mean())
    return 1000 * float(metres), float(np.rad2deg(radians))


def _source_rows(file: NamedCalibration) -> list[tuple[str, str]]:
    calibration, camera = file.calibration, file.calibration.camera
    rows = [("file", file.name)]
    rows += [(key.replace("_", " "), _cell(value)) for key, value in calibration.source.items()]
    if calibration.created:
        rows.append(("created", calibration.created))
    if camera is not None:
        distortion = ", ".join(f"{value:g}" for value in camera.distortion)
        rows += [
            ("image size", f"{camera.width}x{camera.height} pixels"),
            ("focal lengths fx, fy", f"{camera.fx:.3f}, {camera.fy:.3f} pixels"),
            ("principal point cx, cy", f"{camera.cx:.3f}, {camera.cy:.3f} pixels"),
            ("distortion k1 k2 p1 p2 k3 ...", distortion or "none"),
        ]
    titled = {f"{key}_{unit}" for key in _CHECKS for unit in ("mm", "deg")} | _SHOWN_ELSEWHERE
    rows += [
        (key.replace("_", " "), _cell(value))
        for key, value in calibration.checks.items()
        if key not in titled and len(_cell(value)) <= _LONGEST_CELL
    ]
    return rows


def _cell(value: object) -> str:
    if isinstance(value, str):
        return value
    return f"{value:.6g}" if isinstance(value, float) else json.dumps(value)


def _missing(calibration: Calibration) -> list[str]:
    checks, images = set(calibration.checks), calibration.images
    gaps = {
        "No uncertainty: the calibration states none.": not _has_uncertainty(calibration),
        "No list of images: the calibration holds none.": not images,
        "No residuals: the calibration holds none.": images and not _has_residuals(calibration),
        "No error budget: the calibration holds none.": not calibration.error_terms,
        "No repeatability: two halves of the data were not compared.": not (
            {"repeatability_mm", "repeatability_deg"} & checks
        ),
        "No held-out error: no data were held out.": not {"held_out_mm", "held_out_deg"} & checks,
        "No intrinsics: the calibration holds none.": calibration.camera is None,
        "No source: the calibration does not name its command.": not calibration.source,
    }
    return [sentence for sentence, absent in gaps.items() if absent]


def _has_uncertainty(calibration: Calibration) -> bool:
    return bool(np.trace(calibration.covariance) > 0)


def _has_residuals(calibration: Calibration) -> bool:
    return any(i.residual_mm is not None or i.residual_deg is not None for i in calibration.images)
