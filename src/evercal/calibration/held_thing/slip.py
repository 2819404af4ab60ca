"""A camera, or a thing in the gripper, that moved once during a recording."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evercal.errors import InputError
from evercal.geometry import length_mm_deg
from evercal.mapping.built_map import BuiltMap
from evercal.recordings.frame import Frame
from evercal.typing import Array

SLIP_CHANCE = 1e-4
"""Largest probability of a step by chance."""
SLIP_SHARE = 0.5
"""Least share of the sum of squared residuals that a step explains."""


class Step(NamedTuple):
    """A step in a sequence."""

    before: int
    """Number of the first element after it."""
    size: Array
    """(6,) metres and radians."""
    share: float
    """Share of the sum of squares that it explains."""


def refuse_slip(frames: Sequence[Frame], built: BuiltMap) -> None:
    """Refuse a recording of a fixed camera in which the camera or the thing moved once.

    A thing that slips in the gripper steps in the gripper's residuals, a camera in its own.
    """
    correction = built.hand_eye
    assert correction is not None, "the map was built for a hand-eye calibration"
    names = [frame.name for frame in frames if frame.name in correction.residuals]
    largest = None
    what = ""
    for residuals, carrier in (
        (correction.residuals, "what the gripper holds"),
        (correction.moved, "the camera"),
    ):
        step = largest_step(np.array([residuals[name] for name in names]))
        if step is not None and (largest is None or step.share > largest.share):
            largest = step
            what = carrier
    if largest is not None:
        millimetres, degrees = length_mm_deg(largest.size)
        raise InputError(
            f"{what} moved by {millimetres:.1f} mm and {degrees:.2f} deg before image"
            f" {names[largest.before]}: fasten it and record again, or use the images before or"
            " after"
        )


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
        if is_step and (best is None or share > best.share):
            best = Step(k, size, share)
    return best
