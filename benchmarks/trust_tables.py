"""Tables of `benchmarks trust` from its rows."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np

from benchmarks.accuracy import Row, wrong
from evercal.evaluation.metrics import CHI2_6

CORRECTED_PERCENT = 1.0
"""A focal length within this of the true one is right."""
REASON = 80
"""Characters of a reason."""


def lens_tables(rows: Sequence[Row]) -> list[list[Row]]:
    """Summarize cases over all rooms: images, then fixed cameras."""
    images = _grouped([row for row in rows if row["what"] == "image"], "case")
    cameras = _grouped([row for row in rows if row["what"] != "image"], "case")
    return [
        [{"images": name, **_images_row(of)} for name, of in images.items()],
        [{"fixed cameras": name, **_cameras_row(of)} for name, of in cameras.items()],
    ]


def few_tables(rows: Sequence[Row]) -> list[list[Row]]:
    """Summarize numbers of images over all rooms and draws, and count reasons of refusals."""
    sizes = sorted(_grouped(rows, "images").items())
    # Numbers differ between draws.
    reasons = Counter(
        (row["images"], re.sub(r"\d+", "N", str(row["reason"]))[:REASON])
        for row in rows
        if row["status"] != "ok"
    )
    return [
        [{"images": size, **_mounts_row(of)} for size, of in sizes],
        [{"images": s, "reason": r, "refused": n} for (s, r), n in sorted(reasons.items())],
    ]


def arm_tables(rows: Sequence[Row]) -> list[list[Row]]:
    """List draws: the mount, the arm per axis (true and reported), and the fixed camera."""
    errors = ["mm", "deg", "sigma_mm", "sigma_deg", "squared_mahalanobis"]
    tables = (
        [*errors, "warnings", "reason"],
        ["arm_mm", "pose_sigma_mm", "arm_deg", "pose_sigma_deg"],
        [
            "located",
            "frame_mm",
            "frame_deg",
            "fitted_mm",
            "fitted_deg",
            *(f"fixed_{k}" for k in errors),
        ],
    )
    return [
        [{key: row[key] for key in ("room", "draw", *keys) if key in row} for row in rows]
        for keys in tables
    ]


def _images_row(rows: Sequence[Row]) -> Row:
    """Summarize images; errors are those of located ones."""
    found = [row for row in rows if row["status"] == "ok"]
    mm, deg, squared = (_numbers(found, key) for key in ("mm", "deg", "squared_mahalanobis"))
    return {
        "n": len(rows),
        "located %": 100 * len(found) / len(rows),
        **_quantiles(found, 0.95),
        "in ellipsoid %": 100 * float((squared < CHI2_6).mean()) if found else np.nan,
        "1 cm/1 deg %": 100 * float(((mm < 10) & (deg < 1)).sum() / len(rows)),
        "wrong": int(wrong(mm, squared).sum()),
    }


def _cameras_row(rows: Sequence[Row]) -> Row:
    """Summarize fixed cameras."""
    found = [row for row in rows if row["status"] == "ok"]
    summary: Row = {"n": len(rows), "failed": len(rows) - len(found)}
    if not found:
        return summary
    mm, deg, squared = (_numbers(found, key) for key in ("mm", "deg", "squared_mahalanobis"))
    focal = np.abs(_numbers(found, "focal_percent"))
    return summary | {
        "images used": float(np.median(_numbers(found, "used"))),
        "median mm": float(np.median(mm)),
        "worst mm": float(mm.max()),
        "median deg": float(np.median(deg)),
        "worst deg": float(deg.max()),
        **_sigmas(found),
        "worst squared": float(squared.max()),
        "in ellipsoid": int((squared < CHI2_6).sum()),
        "wrong": int(wrong(mm, squared).sum()),
        "worst focal %": float(focal.max()),
        f"focal to {CORRECTED_PERCENT:g} %": int((focal < CORRECTED_PERCENT).sum()),
    }


def _mounts_row(rows: Sequence[Row]) -> Row:
    """Summarize mounts."""
    found = [row for row in rows if row["status"] == "ok"]
    summary: Row = {"n": len(rows), "refused": len(rows) - len(found)}
    if not found:
        return summary
    mm, squared = _numbers(found, "mm"), _numbers(found, "squared_mahalanobis")
    return summary | {
        **_quantiles(found, 0.9),
        **_sigmas(found),
        "in ellipsoid": int((squared < CHI2_6).sum()),
        "wrong": int(wrong(mm, squared).sum()),
        "warned": sum(row["warnings"] != "" for row in found),
    }


def _sigmas(rows: Sequence[Row]) -> Row:
    """Return the median stated deviations."""
    keys = {"sigma mm": "sigma_mm", "sigma deg": "sigma_deg"}
    return {name: float(np.median(_numbers(rows, key))) for name, key in keys.items()}


def _quantiles(rows: Sequence[Row], high: float) -> Row:
    """Return the median and a high quantile of errors, which may be infinite; NaN without any."""
    return {
        f"{name} {unit}": _quantile(_numbers(rows, unit), at)
        for unit in ("mm", "deg")
        for name, at in (("median", 0.5), (f"{100 * high:g} %", high))
    }


def _quantile(values: np.ndarray, at: float) -> float:
    # A mean of neighbours is not defined for infinity.
    return float(np.quantile(values, at, method="higher")) if len(values) else np.nan


def _numbers(rows: Sequence[Row], key: str) -> np.ndarray:
    """(n,) numbers of a column."""
    return np.array([float(row[key]) for row in rows])


def _grouped(rows: Sequence[Row], key: str) -> dict[str | float, list[Row]]:
    """Rows by a value, in order of appearance."""
    groups: dict[str | float, list[Row]] = defaultdict(list)
    for row in rows:
        groups[row[key]].append(row)
    return groups
