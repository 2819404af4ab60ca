"""Robust joint refinement of both unknown transforms, with a covariance that can be believed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, f

from evercal.calibration.pose_pairs.consensus import consensus_start
from evercal.calibration.pose_pairs.noise_levels import (
    Gain,
    NoiseLevels,
    ellipsoid_factor,
    estimate_levels,
    loss_by_weights,
    normal_inverse,
    working_noise,
)
from evercal.calibration.pose_pairs.pose_equation import PoseEquation, Unknowns

_TAILS = 3.0
"""Degrees of freedom of the tails in the first refinement."""
_GROSS = 40.0
"""Squared distance beyond which one of many poses is left out of the first noise levels."""
_PLAIN_BELOW = 12
"""Poses below which not all kinds of noise are told apart: they would be confused."""
MIN_POSES = 5
"""Different poses; of fewer, a wrong one cannot be told from the others."""
Array = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class SolveOptions:
    """What decides the refinement."""

    rejection: float = 0.001
    """Probability that any pose of a recording without outliers is rejected."""
    rounds: int = 12
    """Passes of refinement, noise levels and rejection, at most."""


@dataclass(frozen=True, eq=False)
class HandEyeFit:
    """The refined answer."""

    at: Unknowns
    """Both transforms and the scale."""
    covariance: Array
    """(p, p) of all unknowns in the order of `PoseEquation.jacobian`, before `factor`."""
    factor: float
    """On the covariance, since the noise was judged from few poses, see `ellipsoid_factor`."""
    inliers: Mask
    """(n,) the poses that it rests on."""
    residual: Array
    """(n, 6) of all poses, metres and radians in the axes of `fixed`."""
    distance2: Array
    """(n,) squared distance of each residual in units of its covariance."""
    levels: NoiseLevels
    """What noise the poses show."""
    contributions: Array
    """(k, 6, 6) what each kind of noise adds to the covariance of `parent_from_camera`."""


@dataclass(frozen=True)
class Agreement:
    """How well poses fit together, robustly and quickly judged."""

    at: Unknowns
    """The answer of most of them."""
    metres: float
    """Standard deviation of the board's place per axis."""
    radians: float
    """The same of its rotation."""
    inliers: Mask
    """(n,) which poses lie within some of these."""


def agreement(equation: PoseEquation) -> Agreement:
    """How well poses fit together.

    Args:
        equation: four poses or more.
    """
    n, at = len(equation), consensus_start(equation)
    # Medians of the length of a 3-D normal; the fit follows part of the noise.
    to_sigma = np.sqrt(n / max(n - 2.0, 1.0)) / np.sqrt(chi2.ppf(0.5, 3))
    sigma, distance2 = np.zeros(2), np.zeros(n)
    for _ in range(30):
        lengths = np.linalg.norm(equation.residuals(at).reshape(n, 2, 3), axis=2)
        sigma = np.maximum(np.median(lengths, 0) * to_sigma, 1e-8)
        distance2 = ((lengths / sigma) ** 2).sum(1)
        trust = (_TAILS + 6) / (_TAILS + distance2)
        step, gain = _step(equation, at, trust[:, None, None] * np.diag(np.repeat(sigma**-2.0, 3)))
        at = at.moved(step, equation.scale_known)
        if gain < 1e-2:
            break
    # The median of few is no sure measure: a sound pose may lie far from the others.
    gross = _GROSS * (1 + _GROSS / max(n - 3, 1) ** 2)
    return Agreement(at, float(sigma[0]), float(sigma[1]), distance2 < gross)


def robust_fit(
    equation: PoseEquation, found: Agreement | None = None, options: SolveOptions | None = None
) -> HandEyeFit:
    """Refines the answer of most poses; gross outliers are found and left out.

    Args:
        equation: the poses, sorted so that equal recordings come in equal order; four or more, with
            rotations about two axes.
        found: `agreement(equation)`, where it was computed already.
        options: of the rejection.
    """
    options = options or SolveOptions()
    found = found or agreement(equation)
    at, inliers = found.at, found.inliers
    if inliers.sum() < MIN_POSES:  # too few to tell a wrong pose: all count, and widen the answer
        inliers = np.ones(len(equation), dtype=bool)
    covariance = np.broadcast_to(
        np.diag(np.repeat([found.metres**2, found.radians**2], 3)), (len(equation), 6, 6)
    )
    levels: NoiseLevels | None = None
    seen: list[bytes] = []
    for _ in range(options.rounds):
        at = refine(equation, at, covariance, inliers)
        before, levels = levels, _levels(equation, at, inliers, levels)
        noise = _noise(equation, at, levels)
        covariance = working_noise(noise, inliers)
        distance2 = _distances(equation, at, noise, inliers)
        keep = _agreeing(distance2, inliers, equation.unknowns, options.rejection)
        if keep.sum() < max(MIN_POSES, len(keep) // 2):
            break
        same, settled = bool((keep == inliers).all()), _settled(before, levels)
        # A pose at the threshold may come and go for ever; the second visit decides.
        if (same and settled) or (not same and keep.tobytes() in seen):
            break
        seen.append(inliers.tobytes())
        inliers = keep
    assert levels is not None
    at = refine(equation, at, covariance, inliers)
    return _result(equation, at, inliers, levels)


def refine(equation: PoseEquation, at: Unknowns, covariance: Array, use: Mask) -> Unknowns:
    """Weighted least squares by Gauss and Newton.

    Args:
        equation: n poses.
        at: a start within some degrees and centimetres.
        covariance: (n, 6, 6) of the residuals.
        use: (n,) the poses that count.
    """
    chosen, weight = equation[use], np.linalg.inv(covariance[use])
    for _ in range(30):
        step, gain = _step(chosen, at, weight)
        at = at.moved(step, equation.scale_known)
        if gain < 1e-4:
            break
    return at


def _step(equation: PoseEquation, at: Unknowns, weight: Array) -> tuple[Array, float]:
    """One step of Gauss and Newton, and its squared length in units of the covariance."""
    p = equation.unknowns
    residual = equation.residuals(at)
    jacobian = equation.jacobian(at, residual)
    weighted = (weight @ jacobian).reshape(-1, p)
    normal = weighted.T @ jacobian.reshape(-1, p)
    # Metres and radians per unit of every unknown, so that the solution keeps its digits.
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    right = unit * (weighted.T @ residual.ravel())
    step = -unit * np.linalg.lstsq(normal * np.outer(unit, unit), right, rcond=1e-13)[0]
    return step, float(step @ normal @ step)


def _levels(
    equation: PoseEquation, at: Unknowns, use: Mask, start: NoiseLevels | None
) -> NoiseLevels:
    chosen = equation[use]
    residual = chosen.residuals(at)
    jacobian = chosen.jacobian(at, residual)
    directions = chosen.noise_directions(at, plain=len(equation) < _PLAIN_BELOW)
    known = chosen.known_noise(at)
    return estimate_levels(residual, jacobian, directions, known, start)


def fit_weights(equation: PoseEquation, fit: HandEyeFit) -> Array:
    """(n, 6, 6) covariance that the residuals of a fit were weighted by."""
    return working_noise(_noise(equation, fit.at, fit.levels), fit.inliers)


def least_sigma(equation: PoseEquation, fit: HandEyeFit) -> Array:
    """(p,) standard deviations of the unknowns by the geometry of the poses.

    As if the poses were off by a tenth of a millimetre and a hundredth of a degree: poses without
    any noise would seem to fix what they leave open.
    """
    chosen = equation[fit.inliers]
    jacobian = chosen.jacobian(fit.at, fit.residual[fit.inliers])
    whitened = jacobian / np.repeat([1e-4, np.deg2rad(0.01)], 3)[:, None]
    flat = whitened.reshape(-1, equation.unknowns)
    return np.sqrt(np.diag(normal_inverse(flat.T @ flat)))


def _noise(equation: PoseEquation, at: Unknowns, levels: NoiseLevels) -> Array:
    return levels.covariances(equation.noise_directions(at), equation.known_noise(at))


def _settled(before: NoiseLevels | None, now: NoiseLevels) -> bool:
    if before is None:
        return False
    return bool(np.abs(now.variance - before.variance).max() <= 0.05 * now.variance.max())


def _result(equation: PoseEquation, at: Unknowns, use: Mask, levels: NoiseLevels) -> HandEyeFit:
    """The covariance of the unknowns and how far the truth may lie."""
    noise = _noise(equation, at, levels)
    chosen, residual = equation[use], equation.residuals(at)
    jacobian = chosen.jacobian(at, residual[use])
    gain = Gain.of(jacobian, working_noise(noise, use)[use], noise[use])
    all_kinds = chosen.noise_directions(at)
    kinds = {kind: all_kinds[kind] for kind in levels.kinds}
    covariance = gain.covariance + loss_by_weights(jacobian, noise[use], kinds, levels.uncertainty)
    slopes = gain.slopes(kinds)[:, :6, :6]
    factor = ellipsoid_factor(covariance[:6, :6], slopes, levels.uncertainty)
    distance2 = _distances(equation, at, noise, use)
    parts = slopes * levels.variance[:, None, None]
    return HandEyeFit(at, covariance, factor, use, residual, distance2, levels, parts)


def _distances(equation: PoseEquation, at: Unknowns, noise: Array, use: Mask) -> Array:
    """(n,) squared distance of each residual in units of its covariance."""
    residual = equation.residuals(at)
    jacobian = equation.jacobian(at, residual)
    gain = Gain.of(jacobian[use], working_noise(noise, use)[use], noise[use])
    spread = noise + jacobian @ gain.covariance @ jacobian.transpose(0, 2, 1)
    # A pose that the answer rests on has pulled it along. One that fixes an unknown alone has no
    # spread left along some axis.
    pulled = jacobian[use] @ gain.gain @ noise[use]
    spread[use] -= pulled + pulled.transpose(0, 2, 1)
    spread = spread + 1e-3 * noise
    return (residual * np.linalg.solve(spread, residual[..., None])[..., 0]).sum(1)


def _agreeing(distance2: Array, use: Mask, unknowns: int, rejection: float) -> Mask:
    """(n,) which poses lie as close as noise allows, judged from the noise that they show."""
    freedom = max(6 * int(use.sum()) - unknowns, 2)
    return distance2 < 6 * f.ppf(1 - rejection / len(use), 6, freedom)
