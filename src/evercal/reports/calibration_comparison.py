"""A calibration beside an older one, in sentences."""

from dataclasses import dataclass

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.calibration.located import deviations, length_mm_deg
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.reports.calibration_views import Views


@dataclass(frozen=True, eq=False)
class Older:
    """A calibration to compare with."""

    file: str
    """Name of its file."""
    found: Calibration
    """The calibration."""


def difference(found: Calibration, older: Calibration) -> tuple[float, float]:
    """Millimetres and degrees between two calibrations of one camera.

    Raises:
        InputError: One camera stands still and the gripper carries the other.
    """
    return length_mm_deg(_off(found, older))


def older_sentences(found: Calibration, older: Older, views: Views) -> list[str]:
    """What has changed since the older one.

    Raises:
        InputError: As `difference`.
    """
    before = older.found
    millimetres, degrees = difference(found, before)
    x, y, z = 1000 * _off(found, before)[:3]
    said = (
        f"The camera lies {millimetres:.2f} mm and {degrees:.3f} deg from where {older.file} has"
        f" it: {x:+.2f}, {y:+.2f} and {z:+.2f} mm along x, y and z of {found.parent_frame}."
    )
    if views.axes is not None and views.older is not None:
        pixels = float(np.linalg.norm(views.axes.origin_px - views.older.origin_px))
        if np.isfinite(pixels) and not views.axes.where:
            said += f" In the image {found.parent_frame} moves by {pixels:.1f} pixels."
    blocks = [said]
    if before.parent_frame != found.parent_frame:
        blocks.append(
            f"The older one calls its parent frame {before.parent_frame}; they are taken for the"
            " same frame."
        )
    blocks.append(
        f"Standard deviation per axis: {found.sigma_mm:.2f} mm and {found.sigma_deg:.3f} deg,"
        f" before {before.sigma_mm:.2f} mm and {before.sigma_deg:.3f} deg. {_shared(found, before)}"
    )
    return blocks


def _off(found: Calibration, older: Calibration) -> np.ndarray:
    if found.mount != older.mount:
        raise InputError(
            f"--against: it is {older.mount} and the calibration is {found.mount}; give one of the"
            " same mount"
        )
    return deviations(SE3.stack([found.parent_from_child]), older.parent_from_child)[0]


def _shared(found: Calibration, older: Calibration) -> str:
    """How the two uncertainties bear on the difference."""
    digest = found.source.get("map")
    if digest is not None and digest == older.source.get("map"):
        judge = " ('evercal check' judges it)" if found.mount == "eye_to_hand" else ""
        return (
            "Both come from one map, whose errors cancel in the difference: a shift is known better"
            f" than either pose{judge}."
        )
    return "They do not come from one map, so the errors of both are in the difference."
