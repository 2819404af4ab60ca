"""Tables of the report of a calibration."""

import json
from collections.abc import Sequence
from typing import Literal

import numpy as np

from evercal.calibration.calibration import Calibration, position_shares
from evercal.calibration.verdict import TIERS, tier
from evercal.geometry.camera import COEFFICIENTS
from evercal.reports.page import Table

_SHOWN_ELSEWHERE = ("warnings", "left_open", "camera_sigma", "joints_move_mm")
"""Checks that stand in other parts of the page."""
_DIGITS = {"mm": 2, "deg": 3, "m": 3, "px": 2, "s": 4, "sigmas": 1}
"""Digits of a check, by the unit at the end of its name."""
_LONGEST_CELL = 160
"""Characters of a check in the table, at most."""


def level(calibration: Calibration) -> Literal["good", "fair", "bad", ""]:
    """Colour of the verdict; nothing without a stated uncertainty or checks."""
    if not has_uncertainty(calibration) and not calibration.checks.to_dict():
        return ""
    best = tier(calibration)
    if best is None:
        return "bad"
    if best is TIERS[-1]:
        return "fair"
    return "good"


def suitability_table(calibration: Calibration) -> Table:
    """The uses that a calibration serves."""
    known = level(calibration)
    best = tier(calibration)
    rows = []
    for use in TIERS:
        word = "no"
        if known and best and use.mm >= best.mm:
            word = "yes"
        rows.append((use.name, f"{use.mm:g}", f"{use.deg:g}", word))
    header = (
        "use",
        "position error below (mm)",
        "rotation error below (deg)",
        "suitable",
    )
    caption = "A use is suitable if both expected errors lie below its bounds."
    return Table(header, rows, caption)


def has_uncertainty(calibration: Calibration) -> bool:
    """Whether a covariance is stated."""
    return bool(np.trace(calibration.covariance) > 0)


def deviation_table(
    calibration: Calibration, point_m: tuple[float, float, float] | None = None
) -> Table:
    """Standard deviations along axes: of the position, the rotation, and a point if given."""
    parent = calibration.parent_frame
    child = calibration.child_frame
    uncertain = calibration.uncertain_pose
    variances = np.diag(calibration.covariance).clip(0)
    sigma = np.sqrt(variances)
    axes_mm = 1000 * sigma[:3]
    axes_deg = np.rad2deg(sigma[3:])
    position = [*axes_mm, calibration.sigma_mm]
    rotation = [*axes_deg, calibration.sigma_deg]
    rows = [
        (f"position along the axes of {parent} (mm)", *_fixed_all(position, 3)),
        (f"rotation about the axes of {child} (deg)", *_fixed_all(rotation, 4)),
    ]
    if point_m is not None:
        variances = np.diag(uncertain.point_covariance(point_m)).clip(0)
        axes = 1000 * np.sqrt(variances)
        point = ", ".join(f"{value:g}" for value in point_m)
        name = f"point ({point}) m of {child} along the axes of {parent} (mm)"
        values = [*axes, uncertain.point_sigma_mm(point_m)]
        rows.append((name, *_fixed_all(values, 3)))
    return Table(("", "x", "y", "z", "root mean square"), rows, "Standard deviations")


def error_budget(calibration: Calibration) -> Table:
    """The causes of the uncertainty and their sum."""
    terms = calibration.error_terms
    rows = []
    for term, share in zip(terms, position_shares(terms), strict=True):
        mm = f"{term.translation_mm:.2f}"
        deg = f"{term.rotation_deg:.3f}"
        rows.append((term.name, mm, deg, f"{100 * share:.0f}"))
    if rows:
        mm = f"{calibration.sigma_mm:.2f}"
        deg = f"{calibration.sigma_deg:.3f}"
        rows.append(("all", mm, deg, "100"))
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
    folder = ""
    if len(folders) == 1:
        folder = folders.pop()
    share = checks.information_percent or {}
    moved = checks.leave_one_out_mm or {}
    rows = []
    for image in images:
        rows.append(
            (
                image.name.removeprefix(folder),
                "yes" if image.used else "no",
                image.reason,
                _fixed(image.residual_mm, 2),
                _fixed(image.residual_deg, 3),
                _fixed(share.get(image.name), 1),
                _fixed(moved.get(image.name), 3),
            )
        )
    measures = (
        "residual (mm)",
        "residual (deg)",
        "information (%)",
        "moves position by (mm)",
    )
    used = sum(image.used for image in images)
    caption = f"{used} of {len(images)} images used"
    if folder:
        caption += f", all in {folder}"
    return Table(("name", "used", "reason", *measures), rows, caption)


def camera_table(calibration: Calibration) -> Table:
    """The intrinsics, with standard deviations where they were estimated."""
    camera = calibration.camera
    rows = []
    if camera is not None:
        sigma = calibration.checks.camera_sigma or {}
        rows.append(("the pose is for", calibration.lens or "these", "-"))
        rows.append(("image size (px)", f"{camera.width}x{camera.height}", "-"))
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(camera, name)
            deviation = _fixed(sigma.get(name), 4)
            rows.append((f"{name} (px)", f"{value:.4f}", deviation))
        names = COEFFICIENTS[camera.model]
        for name, value in zip(names, camera.distortion, strict=False):
            deviation = _fixed(sigma.get(name), 4)
            rows.append((name, f"{value:.4f}", deviation))
    return Table(("intrinsics", "value", "standard deviation"), rows)


def check_table(calibration: Calibration) -> Table:
    """The checks that were made and other values estimated with the transform."""
    rows = []
    for key, value in calibration.checks.to_dict().items():
        cell = _cell(value)
        unit = key.rpartition("_")[2]
        label = key.replace("_", " ")
        if unit in _DIGITS and isinstance(value, float):
            label = f"{label.removesuffix(unit)}({unit})"
            cell = _fixed(value, _DIGITS[unit])
        if key not in _SHOWN_ELSEWHERE and len(cell) <= _LONGEST_CELL:
            rows.append((label, cell))
    return Table(("check", "value"), rows)


def source_table(name: str, calibration: Calibration, again: str) -> Table:
    """What the calibration was made from, and what differs where it was made again."""
    source = {"file": name, **calibration.source, "created": calibration.created}
    source["again"] = again
    stated = [(key, value) for key, value in source.items() if value]
    rows = [(key.replace("_", " "), _cell(value)) for key, value in stated]
    if calibration.made is not None:
        rows += [("made by", str(calibration.made)), *calibration.made.inputs.items()]
    return Table(("property", "value"), rows)


def _cell(value: object) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:.4g}"
    return json.dumps(value)


def _fixed(value: float | None, digits: int) -> str:
    if value is None:
        return "-"
    return f"{value:.{digits}f}"


def _fixed_all(values: Sequence[float], digits: int) -> list[str]:
    return [_fixed(value, digits) for value in values]
