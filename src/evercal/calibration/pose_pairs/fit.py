"""Robust joint estimate of all unknowns of the hand-eye equation, and its covariance."""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2, f

from evercal.calibration.pose_pairs.noise_levels import (
    FLOOR,
    Noise,
    clipped_inverse,
    ellipsoid_factor,
    estimate_levels,
    level_uncertainty,
    mean_levels,
    normal_matrix,
    slope_of,
)
from evercal.calibration.pose_pairs.pose_equation import PoseEquation, System, Unknowns
from evercal.classes import frozen, frozen_arrays
from evercal.geometry import norms, spread
from evercal.geometry.normal_equations import normal_solution
from evercal.typing import Array, ArrayPair, BoolArray

_STUDENT_FREEDOM = 3.0
"""Degrees of freedom of the Student t distribution of the residuals in `agreement`."""
_GROSS = 40.0
"""Squared distance of gross outliers, which the first noise estimate ignores."""
_REJECTION = 0.001
"""Probability of rejecting any pose of a recording without outliers."""
_FEW = 8
"""Of poses fewer than this, and by half more, two thirds are used at least, of more a half."""
_MOST_JUDGES = 100
"""Maximum number of poses that estimate the noise levels."""
_MAX_ROUNDS = 12
"""Maximum number of rounds of refinement, noise estimation and rejection."""
_MAX_STEPS = 30
"""Maximum number of Gauss-Newton steps."""
MIN_POSES = 5
"""Minimum number of different poses; an outlier among fewer cannot be detected."""
KINDS = ("translation", "rotation about gripper", "depth", "rotation about board")
"""Kinds of noise: two of an arm, and two of a camera unless corners tell its noise."""


@frozen_arrays
class HandEyeFit:
    """The refined estimate."""

    at: Unknowns
    covariance: Array
    """(p, p) covariance of the unknowns."""
    levels: Array
    """(k,) variances of the kinds of noise, see `estimate_levels`."""
    inliers: BoolArray
    """(n,) poses used for the estimate."""
    residual: Array
    """(n, 6) residuals of all poses in the fixed frame, less the errors that poses share; metres
    and radians."""
    distance2: Array
    """(n,) squared Mahalanobis distance of each residual."""
    contributions: dict[str, Array]
    """(6, 6) covariance of `parent_from_camera` by kind of noise and group of extras."""
    moved: Array
    """(n, 6) change of `parent_from_camera` if a pose is left out; zero for rejected poses."""
    information: Array
    """(n,) share of the information on all unknowns; zero for rejected poses."""

    @property
    def sigma(self) -> Array:
        """(p,) standard deviations of the unknowns."""
        return np.sqrt(np.diag(self.covariance))


@frozen
class Agreement:
    """A quick robust estimate and its residuals."""

    at: Unknowns
    metres: float
    """Standard deviation of the board position per axis."""
    radians: float
    """Standard deviation of the board rotation per axis."""
    inliers: BoolArray
    """(n,) poses without gross errors."""


def agreement(equation: PoseEquation, start: Unknowns) -> Agreement:
    """Estimate how well four or more poses agree, from a start of some degrees and centimetres."""
    n = len(equation)
    at = start
    # Median length of a 3-D normal variable, corrected for the degrees of freedom of the fit.
    to_sigma = np.sqrt(n / max(n - 2.0, 1.0)) / np.sqrt(chi2.ppf(0.5, 3))
    sigma = np.zeros(2)
    distance2 = np.zeros(n)
    for _ in range(_MAX_STEPS):
        system = equation.system(at)
        lengths = norms(system.residual.reshape(n, 2, 3))
        sigma = np.maximum(np.median(lengths, 0) * to_sigma, 1e-8)
        distance2 = ((lengths / sigma) ** 2).sum(1)
        weight = (_STUDENT_FREEDOM + 6) / (_STUDENT_FREEDOM + distance2)
        information = np.diag(np.repeat(sigma**-2.0, 3))
        weighted = weight[:, None, None] * (information @ system.jacobian)
        step, length2 = _step(system, weighted)
        at = at.moved(step)
        if length2 < 1e-2:
            break
    # The median of few poses is uncertain, so an inlier may have a large distance.
    gross = _GROSS * (1 + _GROSS / max(n - 3, 1) ** 2)
    return Agreement(
        at,
        *sigma.tolist(),
        inliers=distance2 < gross,
    )


def robust_fit(
    equation: PoseEquation, start: Agreement, levels: Array | None = None
) -> HandEyeFit:
    """Refine the result of `agreement` for at least four sorted poses, and reject outliers.

    `levels` (k,) are the noise levels of a similar fit.
    """
    n = len(equation)
    at = start.at
    inliers = start.inliers
    least = max(MIN_POSES, n // 2, min(_FEW, int(np.ceil(2 * n / 3))))
    # Outliers cannot be detected; all poses widen the covariance.
    if inliers.sum() < least:
        inliers = np.ones(n, bool)
    for _ in range(_MAX_ROUNDS):
        levels = estimate_levels(_judges(equation, inliers).system(at), levels)
        at = refine(equation, at, levels, inliers)
        distance2 = _distances(equation, at, levels, inliers)[0]
        freedom = max(6 * int(inliers.sum()) - equation.unknowns, 2)
        limit = 6 * f.ppf(1 - _REJECTION / len(inliers), 6, freedom)
        selected = distance2 < limit
        if selected.sum() < least or (selected == inliers).all():
            break
        inliers = selected
    assert levels is not None
    judges = _judges(equation, inliers).system(at)
    if equation.shared:
        levels = mean_levels(judges, levels)
    at = refine(equation, at, levels, inliers)
    fit = _result(equation, at, inliers, levels)
    if equation.shared:
        return fit
    slopes = []
    for kind, level in zip(judges.directions, levels, strict=True):
        slopes.append(fit.contributions[kind] / level)
    uncertainty = level_uncertainty(judges, levels)
    factor = ellipsoid_factor(fit.covariance[:6, :6], np.stack(slopes), uncertainty)
    return replace(fit, covariance=factor * fit.covariance)


def _judges(equation: PoseEquation, use: BoolArray) -> PoseEquation:
    """The used poses that estimate the noise: more of them cost much and tell little."""
    rows = np.flatnonzero(use)
    return equation[rows[spread(len(rows), _MOST_JUDGES)]]


def refine(
    equation: PoseEquation, at: Unknowns, levels: Array, use: BoolArray
) -> Unknowns:
    """Minimize least squares by Gauss-Newton steps; `levels` (k,) are variances of the noise."""
    selected = equation[use]
    noise = Noise(selected.system(at), levels)
    for _ in range(_MAX_STEPS):
        system = selected.system(at)
        weighted = noise.weighted(system.jacobian)
        step, length2 = _step(system, weighted)
        at = at.moved(step)
        if length2 < 1e-4:
            break
    return at


def least_sigma(equation: PoseEquation, fit: HandEyeFit) -> Array:
    """Return the (p,) standard deviations of the unknowns for noise of 0.1 mm and 0.01 degrees.

    With the estimated noise, exact poses would hide an unknown that they do not constrain.
    """
    system = equation[fit.inliers].system(fit.at)
    information = np.repeat([1e-4, np.deg2rad(0.01)], 3) ** -2.0
    normal = normal_matrix(system, information[:, None] * system.jacobian)
    return np.sqrt(np.diag(clipped_inverse(normal)))


def _step(system: System, weighted: Array) -> tuple[Array, float]:
    """Return the Gauss-Newton step (p,) and its squared Mahalanobis length."""
    normal = normal_matrix(system, weighted)
    step = -normal_solution(normal, slope_of(system, weighted))
    return step, float(step @ normal @ step)


def _result(
    equation: PoseEquation, at: Unknowns, use: BoolArray, levels: Array
) -> HandEyeFit:
    used = equation[use].system(at)
    noise = Noise(used, levels)
    weighted = noise.weighted(used.jacobian)
    covariance = clipped_inverse(normal_matrix(used, weighted))
    # (n, p, 6) response of the unknowns to each residual.
    gain = covariance @ weighted.transpose(0, 2, 1)
    by_pose = gain[:, :6]
    contributions: dict[str, Array] = {}
    count = len(used.directions)
    for level, (kind, part) in zip(levels, used.directions.items(), strict=False):
        moves = by_pose @ part
        contributions[kind] = level * (moves @ moves.transpose(0, 2, 1)).sum(0)
    for level, (name, kind) in zip(levels[count:], used.shared.items(), strict=True):
        moves = (by_pose @ kind.slopes).sum(0)
        contributions[name] = level * moves @ moves.T
    known = by_pose @ (used.known + FLOOR) @ by_pose.transpose(0, 2, 1)
    contributions["known"] = known.sum(0)
    for group in dict.fromkeys(equation.extras.groups):
        columns = 12 + equation.extras.indices(group)
        by_prior = covariance[:6, columns]
        prior = used.prior[np.ix_(columns, columns)]
        contributions[group] = by_prior @ prior @ by_prior.T
    # Without a pose its residual no longer pulls on the others.
    own = noise.blocks() - weighted @ covariance @ weighted.transpose(0, 2, 1)
    own += 1e-9 * np.linalg.inv(noise.independent)
    pull = np.linalg.solve(own, noise.weighted(used.residual[..., None]))
    moved = np.zeros((len(use), 6))
    moved[use] = (by_pose @ pull)[..., 0]
    information = np.zeros(len(use))
    shares = np.trace(gain[:, :12] @ used.jacobian[:, :, :12], axis1=1, axis2=2)
    information[use] = shares / 12
    distance2, residual = _distances(equation, at, levels, use)
    return HandEyeFit(
        at=at,
        covariance=covariance,
        levels=levels,
        inliers=use,
        residual=residual,
        distance2=distance2,
        contributions=contributions,
        moved=moved,
        information=information,
    )


def _distances(
    equation: PoseEquation, at: Unknowns, levels: Array, use: BoolArray
) -> ArrayPair:
    """Squared Mahalanobis distances (n,) of each pose from what the other used ones predict.

    Also return the residuals (n, 6) of `predicted`.
    """
    used = equation[use].system(at)
    noise = Noise(used, levels)
    weighted = noise.weighted(used.jacobian)
    covariance = clipped_inverse(normal_matrix(used, weighted))
    pull = noise.weighted(used.residual[..., None])
    own = noise.blocks() - weighted @ covariance @ weighted.transpose(0, 2, 1)
    # In units of the noise, whose axes may differ by orders of magnitude.
    unit = np.linalg.cholesky(noise.independent)
    turned = unit.transpose(0, 2, 1)
    # Alone, one pose has no spread on some axis.
    own = turned @ own @ unit + 1e-3 * np.eye(6)
    pull = turned @ pull
    distance2 = np.zeros(len(use))
    distance2[use] = (pull * np.linalg.solve(own, pull)).sum((1, 2))
    residual, left = predicted(equation, at, levels, use)
    slope = equation.system(at).jacobian
    expected = (1 + 1e-3) * left + slope @ covariance @ slope.transpose(0, 2, 1)
    whitened = np.linalg.solve(expected, residual[..., None])[..., 0]
    distance2[~use] = (residual * whitened).sum(1)[~use]
    return distance2, residual


def predicted(
    equation: PoseEquation, at: Unknowns, levels: Array, use: BoolArray
) -> ArrayPair:
    """Residuals (n, 6) less the errors that poses share, by those that are used.

    Also return the covariance (n, 6, 6) of the rest, if the unknowns were known.
    """
    used = equation[use].system(at)
    noise = Noise(used, levels)
    pull = noise.weighted(used.residual[..., None])
    effects = np.tensordot(noise.shared, pull[..., 0], ((0, 1), (0, 1)))
    every = equation.system(at)
    others = Noise(every, levels)
    left = others.shared @ noise.unexplained() @ others.shared.transpose(0, 2, 1)
    return every.residual - others.shared @ effects, others.independent + left
