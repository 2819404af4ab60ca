"""The HTML report of `evercal report`: a calibration, its quality and its evidence."""

import json
import math
import os
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration
from evercal.calibration.located import deviations, length_mm_deg
from evercal.calibration.verdict import TIERS, expected_error, tier
from evercal.calibration.verdict import verdict as verdict_text
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.reports.calibration_charts import ellipsoid_projections, error_terms, residual_bars
from evercal.reports.calibration_images import AnnotatedImages
from evercal.reports.overlay import encode_image
from evercal.reports.page import Picture, Table, render

_CHECKS = {
    "repeatability": "difference between two halves of the data",
    "held_out": "error on held-out data",
}
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
) -> CalibrationPage:
    """Write the report of a calibration.

    Args:
        file: The calibration.
        images: Its images with overlays.
        store: Path of the store whose landmarks are drawn.
        older: Calibration to compare with.

    Raises:
        InputError: A check of the calibration is not a number, or `older` has another mount.
    """
    calibration = file.calibration
    checks = Table(("check", "mm", "deg"), _check_rows(calibration))
    missing = (*images.missing, *_missing(calibration))
    parent, child = calibration.parent_frame, calibration.child_frame
    certain = not _has_uncertainty(calibration)
    html = render(
        "calibration.html",
        title=f"{file.name}: {parent}_from_{child}",
        calibration=calibration,
        parent=parent,
        child=child,
        verdict=_verdict(calibration),
        transform=_transform_table(calibration),
        matrix="\n".join(
            " ".join(f"{v:13.8f}" for v in row) for row in calibration.parent_from_child.matrix()
        ),
        sigmas=None if certain else _sigma_table(calibration),
        older=older,
        difference=None if older is None else difference(calibration, older.calibration),
        pixel_shift=_pixel_shift(images),
        same_map=older is not None and _same_map(calibration, older.calibration),
        pictures=_pictures(images, parent),
        images=images,
        axes=images.axes,
        origin_px=None if images.axes is None else tuple(images.axes.origin_px),
        older_drawn=images.older_axes is not None and not images.older_axes.outside,
        store=store,
        residuals=_residuals(calibration),
        uses=_use_table(calibration),
        ellipsoid=None if certain else _ellipsoid(calibration),
        terms=_terms(calibration),
        checks=checks,
        source=Table(("property", "value"), _source_rows(file)),
        missing=missing,
    )
    return CalibrationPage(html, missing)


@dataclass(frozen=True)
class _Verdict:
    """Content of the coloured box at the top."""

    level: Literal["good", "fair", "bad", ""]
    """Colour; empty without any measure of quality."""
    headline: str
    details: str
    expected_error: tuple[float, float]
    """Millimetres and degrees."""
    tiers: Table


def _verdict(calibration: Calibration) -> _Verdict:
    best = tier(calibration)
    level = "bad" if best is None else "fair" if best is TIERS[-1] else "good"
    if not _has_uncertainty(calibration) and not _check_rows(calibration):
        level = ""
    headline, _, details = (calibration.verdict or verdict_text(calibration)).partition(". ")
    rows = [
        (t.name, f"{t.mm:g}", f"{t.deg:g}", "yes" if best and t.mm >= best.mm else "no")
        for t in TIERS
    ]
    header = ("use", "position error below (mm)", "rotation error below (deg)", "suitable")
    return _Verdict(level, headline, details, expected_error(calibration), Table(header, rows))


def _transform_table(calibration: Calibration) -> Table:
    pose = calibration.parent_from_child
    w, x, y, z = (f"{value:.8f}" for value in pose.rotation_wxyz)
    position = ", ".join(f"{1000 * value:.3f}" for value in pose.translation_m)
    rows = [("translation x, y, z (mm)", position), ("quaternion x, y, z, w", f"{x}, {y}, {z}, {w}")]
    return Table(("", ""), rows)


def _sigma_table(calibration: Calibration) -> Table:
    sigma = np.sqrt(np.clip(np.diag(calibration.covariance), 0.0, None))
    millimetres, degrees = 1000 * sigma[:3], np.rad2deg(sigma[3:])
    rows = [
        (
            f"position along the axes of {calibration.parent_frame} (mm)",
            *(f"{value:.3f}" for value in (*millimetres, calibration.sigma_mm)),
        ),
        (
            f"rotation about the axes of {calibration.child_frame} (deg)",
            *(f"{value:.4f}" for value in (*degrees, calibration.sigma_deg)),
        ),
    ]
    return Table(("", "x", "y", "z", "root mean square"), rows, "Standard deviations")


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


def _use_table(calibration: Calibration) -> Table:
    folders = {image.name[: image.name.rfind("/") + 1] for image in calibration.images}
    folder = folders.pop() if len(folders) == 1 else ""
    rows = [
        (
            number,
            image.name.removeprefix(folder),
            "yes" if image.used else "no",
            image.reason,
            "-" if image.residual_mm is None else f"{image.residual_mm:.2f}",
            "-" if image.residual_deg is None else f"{image.residual_deg:.3f}",
        )
        for number, image in enumerate(calibration.images, 1)
    ]
    used = sum(image.used for image in calibration.images)
    caption = f"{used} of {len(rows)} images used" + (f", all in {folder}" if folder else "")
    header = ("no.", "image", "used", "reason", "residual (mm)", "residual (deg)")
    return Table(header, rows, caption)


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


@dataclass(frozen=True, eq=False)
class _Ellipsoid:
    """The 95 % ellipsoid of the position."""

    half_axes_mm: tuple[float, float, float]
    """The longest first."""
    longest: tuple[float, float, float]
    """Unit vector along the longest axis, parent frame."""
    angle_deg: float
    """Angle between the longest axis and the viewing direction."""
    picture: Picture


def _ellipsoid(calibration: Calibration) -> _Ellipsoid:
    from scipy import stats

    covariance: NDArray[np.float64] = calibration.covariance[:3, :3]
    values, vectors = np.linalg.eigh(covariance)
    c, b, a = (1000 * np.sqrt(stats.chi2.ppf(_SHARE, 3) * np.clip(values, 0.0, None))).tolist()
    longest = vectors[:, 2] * np.sign(vectors[np.argmax(np.abs(vectors[:, 2])), 2])
    forward = calibration.parent_from_child.rotation_matrix()[:, 2]
    angle = np.rad2deg(np.arccos(np.clip(abs(longest @ forward), 0.0, 1.0)))
    chart = ellipsoid_projections(1e6 * covariance, calibration.parent_frame, _SHARE)
    caption = f"95 % ellipsoid of the position, seen along each axis of {calibration.parent_frame}"
    x, y, z = (longest + 0.0).tolist()
    return _Ellipsoid((a, b, c), (x, y, z), float(angle), Picture(chart, caption))


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
        rows.append(("scatter of single images, per axis", _fixed(scatter[0], 2), _fixed(scatter[1], 3)))
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
        rows += [
            ("image size", f"{camera.width}x{camera.height} pixels"),
            ("focal lengths fx, fy", f"{camera.fx:.3f}, {camera.fy:.3f} pixels"),
            ("principal point cx, cy", f"{camera.cx:.3f}, {camera.cy:.3f} pixels"),
            (
                "distortion k1 k2 p1 p2 k3 ...",
                ", ".join(f"{value:g}" for value in camera.distortion) or "none",
            ),
        ]
    titled = {f"{key}_{unit}" for key in _CHECKS for unit in ("mm", "deg")} | {"image_scatter"}
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
