"""What a calibration says about itself, as rows of tables."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError

_CHECKS = {
    "repeatability": "two halves of the data, apart",
    "held_out": "data that was held out, from the answer",
}
_LONGEST = 160


@dataclass(frozen=True)
class CheckRow:
    """One check that was made."""

    key: str
    """`repeatability` or `held_out`."""
    cells: tuple[str, str, str]
    """What it is, millimetres, degrees."""


def check_rows(found: Calibration) -> list[CheckRow]:
    """The checks that were made.

    Raises:
        InputError: One whose value is no number.
    """
    rows = []
    for key, told in _CHECKS.items():
        millimetres = _number(found.checks, f"{key}_mm")
        degrees = _number(found.checks, f"{key}_deg")
        if millimetres is not None or degrees is not None:
            cells = (
                told,
                "-" if millimetres is None else f"{millimetres:.2f}",
                "-" if degrees is None else f"{degrees:.3f}",
            )
            rows.append(CheckRow(key, cells))
    return rows


def other_rows(found: Calibration) -> list[tuple[str, str]]:
    """All other numbers of the checks that fit a cell."""
    known = {f"{key}_{unit}" for key in _CHECKS for unit in ("mm", "deg")}
    rows = []
    for key, value in found.checks.items():
        if key == "image_scatter":
            rows += _scatter(value)
        elif key not in known:
            text = _cell(value)
            if len(text) <= _LONGEST:
                rows.append((key.replace("_", " "), text))
    return rows


def source_rows(found: Calibration, file: str) -> list[tuple[str, str]]:
    """Where a calibration comes from, and the camera it holds for."""
    rows = [("file", file)]
    order = sorted(
        found.source, key=lambda key: _FIRST.index(key) if key in _FIRST else len(_FIRST)
    )
    rows += [(_SAID.get(key, key.replace("_", " ")), _cell(found.source[key])) for key in order]
    if found.created:
        rows.append(("made at", found.created))
    camera = found.camera
    if camera is not None:
        lens = ", ".join(f"{value:g}" for value in camera.distortion) or "none"
        rows += [
            ("image size", f"{camera.width}x{camera.height} pixels"),
            ("focal lengths fx, fy", f"{camera.fx:.3f}, {camera.fy:.3f} pixels"),
            ("principal point cx, cy", f"{camera.cx:.3f}, {camera.cy:.3f} pixels"),
            ("distortion k1 k2 p1 p2 k3 ...", lens),
        ]
    return rows


_FIRST = ("command", "store", "scene", "map")
_SAID = {"command": "command", "map": "digest of the map"}


def _number(checks: Mapping[str, Any], key: str) -> float | None:
    value = checks.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f"checks.{key} of the calibration is {value!r}; give a number or leave it")
    return float(value)


def _scatter(value: object) -> list[tuple[str, str]]:
    """The (6, 6) scatter of single images in millimetres and degrees."""
    try:
        diagonal = np.diag(np.array(value, dtype=np.float64))
    except ValueError:
        return []
    if diagonal.shape != (6,) or not (diagonal >= 0).all():
        return []
    metres, radians = np.sqrt(diagonal[:3].mean()), np.sqrt(diagonal[3:].mean())
    told = f"{1000 * metres:.2f} mm, {np.rad2deg(radians):.3f} deg per axis"
    return [("scatter of one image", told)]


def _cell(value: object) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:.6g}"
    return json.dumps(value)
