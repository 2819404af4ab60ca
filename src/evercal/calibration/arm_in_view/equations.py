"""Equations of a fit of outlines: parameters, priors, and one robust Gauss-Newton step.

Beside the pose, parameters are what all images share and may be wrong, each with a prior: focal
length, principal point, a common shift of all outlines outwards, and offsets of the joints.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np

from evercal.classes import frozen_arrays
from evercal.geometry import SE3, Camera
from evercal.typing import Array, BoolArray, IntArray

POSE = slice(0, 6)
FOCAL = 6
LENS = slice(6, 9)
OUTLINE = 9
JOINTS = 10
"""Columns of the parameters; one for each joint value from `JOINTS` on."""
LEAST_SCALE_PX = 0.3
"""Least robust standard deviation of the residuals."""
LEAST_REPEATS = 2.0
"""Least number of neighbouring residuals that err alike."""
_LONGEST_STEP = 0.3
"""Metres or radians."""


@frozen_arrays
class Priors:
    """Standard deviations of the parameters before the images."""

    focal: float = 0.005
    """Of the logarithm of the focal length."""
    centre_px: float = 1.0
    """Of the principal point."""
    outline_px: float = 0.25
    """Of a common shift of all outlines: light, blur, simplified meshes."""
    usual: Array = field(default_factory=lambda: np.zeros(0))
    """(k,) of the offsets of joint values; 0 of those that are not estimated."""
    size: float = 1.0
    """Size of the offsets of this arm, in usual ones."""
    lens_is_free: bool = False
    """Whether focal length and principal point are estimated. If not, their errors count all the
    same: a right lens is known better than an arm tells it."""
    pose_only: bool = False
    """Whether nothing but the pose is estimated."""

    def sigma(self) -> Array:
        """(10 + k,) of all parameters; infinite of the pose."""
        pose = np.full(6, np.inf)
        shared = [self.focal, self.centre_px, self.centre_px, self.outline_px]
        return np.concatenate([pose, shared, self.size * self.usual])

    def free(self) -> BoolArray:
        """(10 + k,) whether a parameter is estimated."""
        free = self.sigma() > 0
        free[LENS] &= self.lens_is_free
        free[POSE.stop :] &= not self.pose_only
        return free

    def of_this_arm(self, fit: "ArmFit") -> Self:
        """With joint offsets of the size that they have in a fit.

        The size is estimated as by D. MacKay, Bayesian interpolation, 1992; the usual one counts as
        one joint.
        """
        offsets = self.usual > 0
        variance = np.zeros(len(fit.free))
        variance[fit.free] = np.diag(np.linalg.inv(fit.normal()))
        squares = fit.estimate.parameters**2 + variance
        ratios = squares[JOINTS:][offsets] / self.usual[offsets] ** 2
        size = np.sqrt((1 + ratios.sum()) / (1 + len(ratios)))
        return replace(self, size=float(size))


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pose of a camera, and what all images share."""

    camera_from_base: SE3
    camera: Camera
    parameters: Array
    """(10 + k,) their changes since the start; those of the pose are 0."""

    @property
    def offsets(self) -> Array:
        """(k,) to be added to joint values."""
        return self.parameters[JOINTS:]

    def moved(self, step: Array) -> "Estimate":
        """After a step (10 + k,)."""
        pose = step[POSE]
        longest = np.abs(pose).max()
        pose = pose * min(1.0, _LONGEST_STEP / max(longest, 1e-12))
        change = step.copy()
        change[POSE] = 0
        camera = self.camera.changed(change[LENS]).pinhole
        camera_from_base = SE3.exp(pose) @ self.camera_from_base
        return Estimate(camera_from_base, camera, self.parameters + change)


class Equations(NamedTuple):
    """Residuals of outlines by the parameters: (m,) rows of several images."""

    slopes: Array
    """(m, 10 + k)."""
    px: Array
    """(m,)."""
    image: IntArray
    """(m,)."""
    link: IntArray
    """(m,)."""
    testable: Array
    """(n, links) number of points whose background is known."""


@frozen_arrays
class ArmFit:
    """Result of a fit."""

    estimate: Estimate
    equations: Equations
    weights: Array
    """(m,) robust weights, 0 to 1."""
    scale_px: float
    """Robust standard deviation of the residuals."""
    repeats: float
    """Number of neighbouring residuals that err alike: their information counts once."""
    free: BoolArray
    """(10 + k,) whether a parameter is estimated."""
    priors: Priors

    def information(self) -> Array:
        """(10 + k, 10 + k) of the residuals."""
        weights = self.weights / (self.scale_px**2 * self.repeats)
        slopes = self.equations.slopes
        return (slopes * weights[:, None]).T @ slopes

    def normal(self, free: BoolArray | None = None) -> Array:
        """(p, p) normal matrix of free parameters, with priors."""
        free = self.free if free is None else free
        precision = 1 / self.priors.sigma()[free] ** 2
        return self.information()[np.ix_(free, free)] + np.diag(precision)

    def gradients(self) -> Array:
        """(m, 10 + k) of the residuals."""
        weights = self.weights * self.equations.px / (self.scale_px**2 * self.repeats)
        return self.equations.slopes * weights[:, None]

    def step(self, free: BoolArray, rows: BoolArray | None = None) -> Array:
        """(10 + k,) of the free parameters, by all residuals or some of them."""
        right = self.gradients()
        right = right.sum(0) if rows is None else 2 * right[rows].sum(0)
        precision = 1 / self.priors.sigma()[free] ** 2
        step = np.zeros(len(free))
        spent = precision * self.estimate.parameters[free]
        step[free] = np.linalg.solve(self.normal(free), right[free] - spent)
        return step

    def scatter(self, free: BoolArray) -> Array:
        """(p, p) covariance of the sum of gradients: clusters of images, and of links."""
        gradients = self.gradients()[:, free]
        by_image = _of_clusters(gradients, self.equations.image)
        return by_image + _of_clusters(gradients, self.equations.link)

    @property
    def confirmed(self) -> float:
        """Share of the outline that the images show, 0 to 1."""
        return float(self.weights.sum() / max(self.equations.testable.sum(), 1))


def solved(estimate: Estimate, equations: Equations, priors: Priors) -> ArmFit:
    """One robust Gauss-Newton step."""
    free = priors.free()
    px = equations.px
    if len(px) < 2 * free.sum():
        raise TooFewPoints
    scale = max(LEAST_SCALE_PX, 1.4826 * float(np.median(np.abs(px))))
    weights = 1 / (1 + (px / (2 * scale)) ** 2) ** 2
    fit = ArmFit(estimate, equations, weights, scale, 1.0, free, priors)
    information = fit.information()[np.ix_(free, free)]
    scatter = fit.scatter(free)
    ridge = 1e-9 * np.diag(np.diag(information))
    repeats = np.trace(np.linalg.solve(information + ridge, scatter)) / len(scatter)
    fit = replace(fit, repeats=max(LEAST_REPEATS, float(repeats)))
    return replace(fit, estimate=estimate.moved(fit.step(free)))


def _of_clusters(gradients: Array, owners: IntArray) -> Array:
    _, number = np.unique(owners, return_inverse=True)
    sums = np.zeros((number.max() + 1, gradients.shape[1]))
    np.add.at(sums, number, gradients)
    sums -= sums.mean(0)
    return sums.T @ sums * len(sums) / max(len(sums) - 1, 1)


class TooFewPoints(ValueError):
    """The images show too little of the outline."""
