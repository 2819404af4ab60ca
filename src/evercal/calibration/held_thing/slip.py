"""A camera, or a thing in the gripper, that moved once during a recording."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evercal.errors import InputError
from evercal.geometry import length_mm_deg, norms
from evercal.mapping.built_map import BuiltMap
from evercal.recordings.frame import Frame
from evercal.typing import Array, Strings

SLIP_CHANCE = 1e-4
"""Largest probability of a step by chance."""
SLIP_SHARE = 0.5
"""Least share of the sum of squared residuals that a step explains."""
CLEAR_SHARE = 0.75
"""The same where other errors are likelier: neighbouring poses of an arm err alike."""

MOVED_DEG = 0.1
"""Motion of the background above which the camera moved; tracking errs by a tenth of it."""
LEAST_FRAMES = 3
"""Minimum number of images before and after such a motion."""


class Step(NamedTuple):
    """A step in a sequence."""

    before: int
    """Number of the first element after it."""
    size: Array
    """(6,) metres and radians."""
    share: float
    """Share of the sum of squares that it explains."""


def motion_warnings(
    frames: Sequence[Frame], built: BuiltMap, background: Array
) -> Strings:
    """Refuse a recording of a fixed camera in which the camera or the thing moved once.

    A thing that slips in the gripper steps in the gripper's residuals, a camera in its own. Where
    the background stands still, the camera did not move, and errors of the arm look like it.

    Args:
        frames: (n,) frames of the recording.
        built: The map of the thing.
        background: (n, 2) radians, see `background_motion`.

    Returns:
        Reasons not to rely on the calibration.
    """
    correction = built.hand_eye
    assert correction, "the map was built for a hand-eye calibration"
    used = [i for i, f in enumerate(frames) if f.name in correction.residuals]
    names = [frames[i].name for i in used]
    largest = None
    what = ""
    for residuals, carrier in (
        (correction.residuals, "what the gripper holds"),
        (correction.moved, "the camera"),
    ):
        step = largest_step(np.array([residuals[name] for name in names]))
        if step and (not largest or step.share > largest.share):
            largest = step
            what = carrier
    drift_deg = drift_deg_of(background)
    if largest:
        first = names[largest.before]
        if what == "the camera" and drift_deg < MOVED_DEG:
            if largest.share < CLEAR_SHARE:
                return ()
            return (
                f"the gripper's poses and the images part before image {first}, while the"
                f" background stands still to {drift_deg:.2f} deg: the camera did not move; check"
                " the grip and the arm, or use the images before or after",
            )
        millimetres, degrees = length_mm_deg(largest.size)
        raise InputError(
            f"{what} moved by {millimetres:.1f} mm and {degrees:.2f} deg before image"
            f" {first}: fasten it and record again, or use the images before or after"
        )
    if drift_deg > MOVED_DEG:
        return (
            f"the background moves by {drift_deg:.2f} deg in the recording: fasten the camera and"
            " record again",
        )
    return ()


def drift_deg_of(background: Array) -> float:
    """Motion of a background (n, 2), radians, between the halves that differ most, in degrees.

    NaN if it is not known.
    """
    known = background[np.isfinite(background).all(1)]
    if 2 * len(known) < len(background) or len(known) < 2 * LEAST_FRAMES:
        return np.nan
    places = range(LEAST_FRAMES, len(known) - LEAST_FRAMES + 1)
    steps = [np.median(known[k:], 0) - np.median(known[:k], 0) for k in places]
    return float(np.rad2deg(norms(steps).max()))


def largest_step(values: Array) -> Step | None:
    """The step that explains most of deviations (n, 6), metres and radians; None by chance."""
    from scipy import stats

    n = len(values)
    best = None
    for k in range(2, n - 1):
        size = values[k:].mean(0) - values[:k].mean(0)
        squares = (values - values.mean(0)) ** 2
        total = squares.reshape(n, 2, 3).sum((0, 2))
        step = (size**2).reshape(2, 3).sum(1)
        by_step = k * (n - k) / n * step
        rest = np.maximum(total - by_step, 1e-18)
        freedom = 3 * (n - 2)
        ratio = (by_step / 3) / (rest / freedom)
        # Two residuals are tested, at n places.
        chance = stats.f.sf(ratio, 3, freedom).min() * 2 * n
        share = float((by_step / np.maximum(total, 1e-18)).max())
        is_step = chance < SLIP_CHANCE and share > SLIP_SHARE
        if is_step and (not best or share > best.share):
            best = Step(k, size, share)
    return best
