"""`judge`: whether a calibration errs as it states, by data that it has not seen.

The test compares the residuals with what the stated covariance predicts. Sizes of errors and their
causes are those of a mixture: all errs as stated, or one cause by more.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Literal

import numpy as np
from scipy import stats

from evercal.calibration.evidence import Data, Evidence, plus
from evercal.calibration.framed_pose import FramedPose
from evercal.classes import frozen
from evercal.geometry import norms
from evercal.robot.pose_errors import ArmErrors
from evercal.storage.provenance import now
from evercal.typing import Array, JsonObject, Triple

Verdict = Literal["honest", "not as stated", "cannot tell"]
_QUANTILES = (0.01, 0.5, 0.95)
"""Of the factor between true and stated errors. As its prior is that of a scale, the first one is
above 1 for at most that share of calibrations that err as they state."""
_UNLIKELY = 0.002
"""Probability of d2 below which a calibration does not err as it states, whatever the factor."""
EXCLUDED = 4.0
"""Data that do not exclude errors of so many times the stated ones tell nothing."""
_NOISIER = 4.0
"""Most by which the variance of the noise is raised where the data disagree among themselves."""
_FOCAL = 1e-3
"""Standard deviation of a calibrated focal length, as a share."""
_FACTORS = np.geomspace(0.1, 100, 121)
"""Factors of the stated errors that are compared."""
_DRAWS = 4000
"""Number of errors that are drawn for their size at the places."""
_CAUSES = {
    "position of the camera": (1, 0, 0, 0),
    "rotation of the camera": (0, 2, 0, 0),
    "position and rotation of the camera": (1, 2, 0, 0),
    "focal length or principal point": (0, 0, 1, 0),
    "joints of the arm": (0, 0, 0, 1000),
}
"""Errors of position in metres, rotation in radians, intrinsics as shares, and joints in their
usual sizes, for a size of 1."""
_SIZES = ((0.001,), (0.003,), (0.01,), (0.03,))
"""Sizes of errors that are compared."""
_REMEDIES = {
    "not as stated": "Measure again; if it stays, calibrate again. Check the lens, the tool and the"
    " zeros of the joints if they are a likely cause.",
    "cannot tell": "More of such data from other places, or more exact data, would tell.",
}


@frozen
class Verification:
    """Whether a calibration errs as it states."""

    verdict: Verdict
    data: str
    """What it was tested with, in words."""
    reach_m: float
    """Largest distance from the base of the places that the errors are of."""
    error_mm: float
    """Root mean square error of these places, by calibration and data."""
    error_95_mm: float
    """Error that 95 % are below."""
    stated_mm: float
    """Root mean square error of these places as the calibration states it."""
    d2: float
    """Squared Mahalanobis distance of the residuals, 6 or less for one that errs as it states."""
    factor: Triple
    """True errors over stated ones: the 1 %, 50 % and 95 % quantile."""
    causes: Mapping[str, float]
    """Probabilities of errors that would explain the residuals, if they are not as stated."""
    misses_m: Mapping[str, float]
    """Distance of each measured place from its prediction, by its name."""
    created: str
    """ISO 8601 time with zone."""

    @property
    def agrees(self) -> bool:
        """Whether nothing contradicts the calibration."""
        return self.verdict != "not as stated"

    @property
    def advice(self) -> str:
        """What to do, or what would tell more; empty if nothing."""
        return _REMEDIES.get(self.verdict, "")

    @property
    def sentence(self) -> str:
        """The answer in one sentence."""
        return (
            f"{self.data}: within {100 * self.reach_m:.0f} cm of the base errors of"
            f" {self.error_mm:.2f} mm (95 %: {self.error_95_mm:.2f} mm); stated"
            f" {self.stated_mm:.2f} mm: {self.verdict}"
        )

    def __repr__(self) -> str:
        return f"Verification({self.sentence})"

    def to_dict(self) -> JsonObject:
        """Return JSON values."""
        return asdict(self)


def judge(
    calibration: FramedPose, data: Data, errors: ArmErrors | None = None
) -> Verification:
    """Test a calibration; `errors` of the arm are expected where they are given."""
    pose = calibration.parent_from_child
    evidence = data.evidence(pose, errors)
    known = np.c_[_FOCAL * evidence.lens[:, :1], bool(errors) * evidence.arm]
    noise = evidence.noise + known @ known.T
    whitening = np.linalg.inv(np.linalg.cholesky(noise))
    slope = whitening @ evidence.slope
    own, axes = np.linalg.eigh(slope @ calibration.covariance @ slope.T)
    squares = (axes.T @ whitening @ evidence.residual) ** 2
    # What no error of the calibration explains shows the noise.
    freedom = max(len(own) - 6 - data.free, 1)
    noisier = np.clip(squares[:-6].sum() / freedom, 1.0, _NOISIER)
    own = own[-6:].clip(0) / noisier
    squares = squares[-6:] / noisier
    factor = _factor(squares, own)
    model = evidence._replace(noise=noisier * noise)
    drawn, causes = _mixture(calibration, model)
    d2 = float((squares / (1 + own)).sum())
    verdict: Verdict = "cannot tell"
    if factor[0] > 1 or d2 > stats.chi2.isf(_UNLIKELY, len(own)):
        verdict = "not as stated"
    elif factor[2] < EXCLUDED:
        verdict = "honest"
    sizes = []
    for errors_of_pose in drawn:
        moved = plus(pose, errors_of_pose)[:, None].apply(data.places)
        sizes.append(1000 * norms(moved - pose.apply(data.places)))
    error, stated = np.sqrt(np.mean(np.square(sizes), (1, 2))).tolist()
    return Verification(
        verdict,
        data.what,
        data.reach_m,
        error,
        float(np.quantile(sizes[0], 0.95)),
        stated,
        d2,
        factor,
        causes,
        data.misses_m,
        now(),
    )


def _factor(squares: Array, own: Array) -> Triple:
    """Quantiles of the true errors over the stated ones."""
    variance = 1 + np.outer(_FACTORS**2, own)
    costs = (np.log(variance) + squares / variance).sum(1) / 2
    share = np.exp(costs.min() - costs).cumsum()
    wanted = np.array(_QUANTILES) * share[-1]
    low, middle, high = np.interp(wanted, share, _FACTORS).tolist()
    return low, middle, high


def _mixture(
    calibration: FramedPose, evidence: Evidence
) -> tuple[Array, dict[str, float]]:
    """Errors (2, m, 6) that are drawn by the data and as stated, and probabilities of causes."""
    units = np.ones(9 + evidence.arm.shape[1])
    if calibration.camera:
        units[7:9] = calibration.camera.width
    kinds = np.repeat([*_CAUSES.values()], [3, 3, 3, len(units) - 9], 1)
    variances = np.kron(kinds * units, _SIZES) ** 2
    variances = np.r_[0 * variances[:1], variances]
    priors = variances[:, None] * np.eye(len(units))
    priors[:, :6, :6] += calibration.covariance
    slope = np.c_[evidence.slope, evidence.lens, evidence.arm]
    by_pose = slope @ priors[:, :, :6]
    whole = slope @ priors @ slope.T + evidence.noise
    gain = np.linalg.solve(whole, by_pose)
    mean = evidence.residual @ gain
    spread = priors[:, :6, :6] - by_pose.swapaxes(1, 2) @ gain
    weighted = np.linalg.inv(whole) @ evidence.residual
    costs = weighted @ evidence.residual + np.linalg.slogdet(whole)[1]
    weights = np.exp((costs.min() - costs) / 2)
    by_cause = weights[1:].reshape(len(kinds), -1).sum(1)
    by_cause /= by_cause.sum()
    weights[0] *= len(weights) - 1
    rng = np.random.default_rng(0)
    which = rng.choice(len(weights), _DRAWS, p=weights / weights.sum())
    sizes, axes = np.linalg.eigh(spread)
    roots = axes * np.sqrt(sizes.clip(0))[:, None]
    normal = rng.standard_normal((_DRAWS, 6, 1))
    drawn = mean[which] + (roots[which] @ normal)[:, :, 0]
    stated = rng.multivariate_normal(np.zeros(6), calibration.covariance, _DRAWS)
    names = dict(zip(_CAUSES, by_cause.tolist(), strict=True))
    return np.stack([drawn, stated]), names
