"""Tables of a calibration report."""

import json

import numpy as np

from evercal.calibration.calibration import Calibration, position_shares
from evercal.reports.page import Table

_SHOWN_ELSEWHERE = ("warnings", "left_open", "camera_sigma")
_LONGEST_CELL = 160


def deviation_table(
    calibration: Calibration, point_m: tuple[float, float, float] | None = None
) -> Table:
    """Standard deviations along axes: of the position, the rotation, and a point if given."""
    parent, child = calibration.parent_frame, calibration.child_frame
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
        rows.append((name, *(f"{v:.3f}" for v in (*axes, uncertain.point_sigma_mm(point_m)))))
    return Table(("", "x", "y", "z", "root mean square"), rows, "Standard deviations")


def error_budget(calibration: Calibration) -> Table:
    """The causes of the uncertainty and their sum."""
    terms = calibration.error_terms
    rows = [
        (term.name, f"{term.translation_mm:.2f}", f"{term.rotation_deg:.3f}", f"{100 * share:.0f}")
        for term, share in zip(terms, position_shares(terms), strict=True)
    ]
    if rows:
        total = f"{calibration.sigma_mm:.2f}", f"{calibration.sigma_deg:.3f}"
        rows.append(("all", *total, "100"))
    header = ("cause", "position (mm)", "rotation (deg)", "share of the position's variance (%)")
    return Table(header, rows, "Error budget: standard deviation per axis by cause")


def use_table(calibration: Calibration) -> Table:
    """All images with their use; those of boards with what they contribute."""
    images, checks = calibration.images, calibration.checks
    folders = {image.name[: image.name.rfind("/") + 1] for image in images}
    folder = folders.pop() if len(folders) == 1 else ""
    share, moved = (checks.get(key, {}) for key in ("information_percent", "leave_one_out_mm"))
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
    measures = ("residual (mm)", "residual (deg)", "information (%)", "moves position by (mm)")
    used = sum(image.used for image in images)
    caption = f"{used} of {len(images)} images used" + (f", all in {folder}" if folder else "")
    return Table(("name", "used", "reason", *measures), rows, caption)


def camera_table(calibration: Calibration) -> Table:
    """The intrinsics, with standard deviations where they were estimated."""
    camera, rows = calibration.camera, []
    if camera is not None:
        sigma = calibration.checks.get("camera_sigma", {})
        values = {f"{name} (px)": getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
        names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        values |= dict(zip(names, camera.distortion, strict=False))
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
        for key, value in calibration.checks.items()
        if key not in _SHOWN_ELSEWHERE and len(_cell(value)) <= _LONGEST_CELL
    ]
    return Table(("check", "value"), rows)


def source_table(name: str, calibration: Calibration) -> Table:
    """What the calibration was made from."""
    source = {"file": name, **calibration.source, "created": calibration.created}
    rows = [(key.replace("_", " "), _cell(value)) for key, value in source.items() if value]
    return Table(("property", "value"), rows)


def _cell(value: object) -> str:
    if isinstance(value, str):
        return value
    return f"{value:.6g}" if isinstance(value, float) else json.dumps(value)


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
