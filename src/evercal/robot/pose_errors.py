"""Errors that stated gripper poses share, as kinds with a Gaussian prior.

Poses of an arm do not err independently: offsets of its joints, bent links and a base that gives
way move neighbouring poses alike, and heat moves those of one time alike. An error of a kind is the
sum of unit effects, each multiplied by a normal variable with the size of the kind. So a kind is a
covariance of rank r over all poses. Its size is estimated from the recording, see
`evercal.calibration.pose_pairs.noise_levels` and `evercal.mapping.shared_levels`.

The covariance of all errors is the sum of a block of each pose and a matrix of low rank, and is
inverted as such: M. Woodbury, Inverting modified matrices, 1950.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_solve, solve_triangular
from scipy.optimize import minimize

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance, spread
from evercal.typing import Array, BoolArray, IntArray

if TYPE_CHECKING:
    from evercal.robot.arm import Arm

_UNKNOWN_RAD = np.deg2rad(0.2)
"""Usual standard deviation of joint offsets, of a cobot."""
WANTED = 1.0
"""Evidence of shared errors that takes them in: the logarithm of the likelihood ratio to
independent errors."""
_LINKS_M = 3e-4
"""Usual standard deviation of the lengths of links."""
_USUAL_REACH_M = 0.5
"""Lever on which such a rotation moves a gripper."""
_SMOOTH_M = 1.0
"""Distance over which smooth errors change: a workspace."""
_SMOOTH_RAD = 2.0
"""Rotation over which they change: the range of a joint."""
_DRIFT_SAMPLES = 4.0
"""Number of poses over which drift changes."""
_MOST_PLACES = 60
"""Number of poses that smooth errors are interpolated between, and drift."""
_LEAST_SHARE = 1e-3
"""Effects with a smaller share of the variance of the largest are left out."""


FIRST_SHARED = 0.3
"""First variance of a shared kind, in variances of the residuals."""
_SMALLEST = -16.0
"""Smallest logarithm of a variance, from that of its start."""
_LARGEST = 9.0
"""Largest one."""
_PRECISION = 1e-5
"""Relative change of the likelihood that ends its maximization."""


class SharedErrors(NamedTuple):
    """One kind of errors that n poses share."""

    slopes: Array
    """(n, 6, r) errors of the poses by unit effects: translation and rotation in the axes of the
    gripper; metres and radians."""
    usual: float
    """Prior standard deviation of the size, metres or radians."""

    def of_rows(self, rows: IntArray | BoolArray) -> SharedErrors:
        """The errors of some of the poses."""
        return self._replace(slopes=self.slopes[rows])


class ArmErrors(NamedTuple):
    """What is known of an arm whose poses are stated."""

    arm: Arm | None = None
    """Its kinematics; without it, those of usual arms."""
    accuracy_rad: float | None = None
    """Prior standard deviation of an offset of a joint. Default: that of the arm's class."""
    accuracy_m: float | None = None
    """The same by the position of the gripper, which all joints move."""

    @classmethod
    def stated(cls, arm: str | None, accuracy: str | None) -> ArmErrors:
        """The arm of a name or URDF, and an accuracy: 0.2deg of joints, 1mm of the gripper."""
        from evercal.robot.known_arms import arm_of

        known = None if arm is None else arm_of(arm)
        if accuracy is None:
            return cls(known)
        number = re.fullmatch(r"(\d*\.?\d*[1-9]\d*) ?(deg|mm)", accuracy)
        if number is None:
            raise InputError(
                f"`arm_accuracy` {accuracy!r}: give the standard deviation of the joints, such as"
                " 0.2deg, or of the gripper, such as 1mm"
            )
        size = float(number[1])
        if number[2] == "deg":
            return cls(known, accuracy_rad=np.deg2rad(size))
        return cls(known, accuracy_m=size / 1000)

    def offset_rad(self, slopes: Array) -> float:
        """Prior standard deviation of an offset of a joint, by slopes (n, 6, k) of the joints."""
        if self.accuracy_rad is not None:
            return self.accuracy_rad
        if self.accuracy_m is not None:
            lever_m = np.sqrt((slopes[:, :3] ** 2).sum() / len(slopes))
            return self.accuracy_m / float(lever_m)
        if not self.arm:
            return _UNKNOWN_RAD
        from evercal.robot.known_arms import ARM_NAMES, USUAL_RAD

        name = self.arm.name
        return USUAL_RAD[ARM_NAMES.get(name, "cobot")]


def shared_errors(base_from_gripper: SE3, errors: ArmErrors) -> dict[str, SharedErrors]:
    """Kinds of errors of gripper poses (n,) in the order of time, by name."""
    from evercal.robot.joint_slopes import joint_slopes

    usual = joint_slopes(base_from_gripper, None)
    slopes = usual
    if errors.arm:
        slopes = joint_slopes(base_from_gripper, errors.arm)
    joints = _main_effects(slopes)
    accuracy_rad = errors.offset_rad(slopes)
    n = len(base_from_gripper)
    metres, radians = pose_distance(base_from_gripper[:, None], base_from_gripper)
    shares = (metres / _SMOOTH_M) ** 2 + (radians / _SMOOTH_RAD) ** 2
    apart = np.sqrt(3 * shares)
    # Matern covariance of order 3/2: smooth, with details of all sizes.
    smooth = (1 + apart) * np.exp(-apart)
    samples = max(_DRIFT_SAMPLES, 2 * n / _MOST_PLACES)
    times = np.arange(n) / samples
    steps = times[:, None] - times
    drift = np.exp(-0.5 * steps**2)
    moved_m = accuracy_rad * _USUAL_REACH_M
    kinds = {}
    kinds["joint offsets"] = SharedErrors(
        joints,
        accuracy_rad,
    )
    # Along the axes of joints, as of a usual arm: they have all directions of links.
    links = np.zeros_like(usual)
    links[:, :3] = usual[:, 3:]
    kinds["link lengths translation"] = SharedErrors(
        _main_effects(links),
        _LINKS_M,
    )
    correlations = {
        "smooth": smooth,
        "drift": drift,
    }
    for name, correlation in correlations.items():
        effects = _effects(correlation)
        shape = (2, n, 6, 3, effects.shape[1])
        shift, turn = np.zeros(shape)
        for axis in range(3):
            shift[:, axis, axis] = effects
            turn[:, 3 + axis, axis] = effects
        kinds[f"{name} translation"] = SharedErrors(
            shift.reshape(n, 6, -1),
            moved_m,
        )
        kinds[f"{name} rotation"] = SharedErrors(
            turn.reshape(
                n,
                6,
                -1,
            ),
            accuracy_rad,
        )
    return kinds


def _main_effects(slopes: Array) -> Array:
    """(n, 6, r) fewer effects with nearly the covariance of (n, 6, k)."""
    columns = slopes.reshape(-1, slopes.shape[2])
    effects, size, _ = np.linalg.svd(columns, full_matrices=False)
    least = np.sqrt(_LEAST_SHARE) * size[0]
    large = size > least
    main = effects[:, large] * size[large]
    return main.reshape(
        len(slopes),
        6,
        -1,
    )


def _effects(correlation: Array) -> Array:
    """(n, r) factor of a correlation matrix (n, n), by Nystroem's approximation.

    C. Williams and M. Seeger, Using the Nystroem method to speed up kernel machines, 2000.
    """
    places = spread(len(correlation), _MOST_PLACES)
    among = correlation[np.ix_(places, places)]
    values, axes = np.linalg.eigh(among)
    large = values > _LEAST_SHARE * values[-1]
    scaled = axes[:, large] / np.sqrt(values[large])
    return correlation[:, places] @ scaled


class SharedNoise:
    """Covariance of the errors (n, 6) of poses.

    `variance` (k,) are those of the k kinds `shared`.
    """

    def __init__(
        self,
        independent: Array,
        variance: Array,
        shared: Mapping[str, SharedErrors],
    ) -> None:
        self.independent = independent
        """(n, 6, 6) of errors that no other pose shares."""
        n = len(independent)
        parts = [np.zeros((n, 6, 0))]
        for size, kind in zip(
            np.sqrt(variance),
            shared.values(),
            strict=True,
        ):
            parts.append(size * kind.slopes)
        self.shared = np.concatenate(parts, 2)
        """(n, 6, r) errors by the effects of all kinds that poses share; their covariance is the
        identity before the errors are known."""
        self.information = np.linalg.inv(independent)
        rank = self.shared.shape[2]
        flat = self.shared.reshape(6 * n, rank)
        weighted = (self.information @ self.shared).reshape(6 * n, rank)
        inner = flat.T @ weighted
        inner.flat[:: rank + 1] += 1.0
        self._root = np.linalg.cholesky(inner)
        half = solve_triangular(
            self._root,
            weighted.T,
            lower=True,
            check_finite=False,
        )
        self.half = half.T
        """(6 n, r): the inverse covariance is that of independent errors less half @ half.T."""

    def weighted(self, values: Array) -> Array:
        """Multiply (n, 6, m) by the inverse covariance."""
        own = self.information @ values
        flat = values.reshape(len(self.half), values.shape[2])
        shared = self.half @ (self.half.T @ flat)
        return own - shared.reshape(own.shape)

    def blocks(self) -> Array:
        """(n, 6, 6) blocks of the inverse covariance."""
        half = self.half.reshape(*self.shared.shape)
        return self.information - half @ half.transpose(
            0,
            2,
            1,
        )

    def inverse(self) -> Array:
        """(6 n, 6 n) inverse covariance."""
        return block_diag(*self.information) - self.half @ self.half.T

    def unexplained(self) -> Array:
        """(r, r) covariance of the effects, if the errors were known but for independent ones."""
        return cho_solve((self._root, True), np.eye(len(self._root)))

    def logarithm(self) -> float:
        """Logarithm of the determinant of the covariance."""
        own = np.linalg.slogdet(self.independent)[1].sum()
        return float(own + 2 * np.log(np.diag(self._root)).sum())


def most_likely(
    likelihood: Callable[[Array], tuple[float, Array]],
    first: Array,
    start: Array,
) -> tuple[Array, float]:
    """Variances (k,) of the largest likelihood, and twice its negative logarithm.

    Args:
        likelihood: Twice its negative logarithm, and the slope, by logarithms of variances.
        first: (k,) rough variances, by which the search is bounded.
        start: (k,) variances where the search starts.
    """
    bounds = [(value + _SMALLEST, value + _LARGEST) for value in np.log(first)]
    found = minimize(
        likelihood,
        np.log(start),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"ftol": _PRECISION},
    )
    return np.exp(found.x), float(found.fun)
