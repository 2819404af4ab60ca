"""`shared_levels`: sizes of the errors that stated poses share, by the evidence of the images.

The posterior of the errors under one prior, divided by this prior, is what the images say. With it
the likelihood of any other prior follows in closed form, without another adjustment.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from evercal.classes import frozen_arrays
from evercal.geometry import spread
from evercal.robot.pose_errors import (
    FIRST_SHARED,
    WANTED,
    SharedErrors,
    SharedNoise,
    most_likely,
)
from evercal.typing import Array

_MOST_JUDGES = 60
"""Maximum number of frames that estimate the sizes."""
_LEAST_INFORMATION = 1e-9
"""Lower bound of what the images say, as a share of the most in any direction."""


@frozen_arrays
class _Seen:
    """What the images say about n errors of stated poses, and how these vary beforehand."""

    information: Array
    """(6 n, 6 n) of the images on the errors."""
    pull: Array
    """(6 n,) `information` times the errors that fit the images best."""
    unit: tuple[Array, ...]
    """(n, 6, 6) of independent errors for one metre^2, and for one radian^2."""
    kinds: Mapping[str, SharedErrors]

    def noise(self, variance: Array) -> SharedNoise:
        """Covariance of the errors by variances (2 + k,)."""
        own = variance[0] * self.unit[0] + variance[1] * self.unit[1]
        return SharedNoise(own, variance[2:], self.kinds)

    def likelihood(self, logarithms: Array) -> tuple[float, Array]:
        """Twice the negative logarithm of the likelihood of variances, and its slope."""
        variance = np.exp(logarithms)
        noise = self.noise(variance)
        inverse = noise.inverse()
        posterior = np.linalg.inv(self.information + inverse)
        mean = posterior @ self.pull
        value = noise.logarithm() - np.linalg.slogdet(posterior)[1] - self.pull @ mean
        rest = inverse - inverse @ (posterior + np.outer(mean, mean)) @ inverse
        slope = []
        blocks = rest.reshape(
            len(noise.independent),
            6,
            -1,
            6,
        )
        own = np.einsum("niNj,nN->nij", blocks, np.eye(len(blocks)))
        for size, unit in zip(variance, self.unit, strict=False):
            slope.append(size * (own * unit).sum())
        for size, kind in zip(
            variance[2:],
            self.kinds.values(),
            strict=True,
        ):
            effects = kind.slopes.reshape(len(rest), -1)
            usual = size / kind.usual**2
            value += usual
            slope.append(size * (effects * (rest @ effects)).sum() + usual)
        return float(value), np.array(slope)


def shared_levels(
    errors: Array,
    rows: Array,
    weight: Array,
    sigma: Array,
    kinds: Mapping[str, SharedErrors],
) -> Array | None:
    """Variances (2 + k,) of independent positions and rotations and of each shared kind.

    None where the images do not ask for shared errors.

    Args:
        errors: (n, 6) posterior mean of the errors, metres and radians.
        rows: (r, n, 6) factor of their posterior covariance, rows^T rows.
        weight: (n,) by which the variance of independent errors is divided.
        sigma: (6,) standard deviations of the prior that posterior and mean belong to.
        kinds: Kinds of errors that may be shared.
    """
    judges = spread(len(errors), _MOST_JUDGES)
    flat = rows[:, judges].reshape(len(rows), -1)
    posterior = np.linalg.inv(flat.T @ flat)
    variance = sigma**2 / weight[judges, None]
    information = posterior - np.diag(1 / variance.ravel())
    values, axes = np.linalg.eigh(information)
    values = values.clip(_LEAST_INFORMATION * values[-1])
    unit = np.zeros((2, len(judges), 6, 6))
    for i in range(6):
        unit[i // 3, :, i, i] = 1 / weight[judges]
    seen = _Seen(
        (axes * values) @ axes.T,
        posterior @ errors[judges].ravel(),
        tuple(unit),
        {name: kind.of_rows(judges) for name, kind in kinds.items()},
    )
    first = sigma[[0, 3]] ** 2
    _, alone = most_likely(replace(seen, kinds={}).likelihood, first, first)
    shared = [first[int(not name.endswith("translation"))] for name in kinds]
    first = np.r_[first, FIRST_SHARED * np.array(shared)]
    found, least = most_likely(seen.likelihood, first, first)
    if (alone - least) / 2 < WANTED:
        return None
    return found
