"""Whether distances to the board err together with the focal length: a lens that was focused again.

Another focal length moves the board along its viewing ray, by a share of its distance. Noise of the
corners does so, too: where it is unknown, only one step over the recording counts.
"""

from collections.abc import Sequence

import numpy as np

from evercal.calibration.pose_pairs.fit import HandEyeFit
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.geometry import norms
from evercal.mapping.changed_lens import LensChange
from evercal.typing import IntArray

_LEAST_SIGMA = 0.0005
"""Smallest standard deviation of a distance, as a share of it."""
_BESIDE = 3.0
"""Errors along the ray, in errors across it, that noise explains."""


def focus_warning(
    equation: PoseEquation, fit: HandEyeFit, rows: IntArray, names: Sequence[str]
) -> list[str]:
    """Return a warning where distances change by a share, from image to image or in one step.

    `rows` (n,) are the rows of the equation in the order of `names`.
    """
    ray = equation.viewing_rays(fit.at)
    distance = norms(ray)
    shift = fit.residual[:, :3]
    if distance.min() <= np.median(norms(shift)):
        return []
    direction = ray / distance[:, None]
    along = (shift * direction).sum(1)
    across = norms(shift - along[:, None] * direction) / np.sqrt(2)
    known = equation.system(fit.at).known[:, :3, :3]
    by_corners = np.einsum("ni,nij,nj->n", direction, known, direction)
    sigma = np.hypot(_BESIDE * np.median(across), np.sqrt(by_corners)) / distance
    share = np.stack([along / distance, np.maximum(sigma, _LEAST_SIGMA)], 1)
    order = np.argsort(rows)
    change = LensChange.of(share[order])
    if change.first < 0:
        order = order[fit.inliers[order]]
        change = LensChange.of(share[order])
    if not change.size or (change.first < 0 and not by_corners.any()):
        return []
    how = f"by {100 * change.size:.1f} % (standard deviation) from image to image"
    if change.first >= 0:
        at = names[int(rows[order[change.first]])]
        how = f"by {100 * abs(change.size):.1f} % at {at}"
    return [
        f"distances from camera to board change {how}, positions across them hardly: does the"
        " lens focus by itself, or was it zoomed? Fix focus and zoom, and record again"
    ]
