"""Variances of the priors of a bundle adjustment, estimated from its own result.

Each function estimates one of them. Variance components: Foerstner and Wrobel, Photogrammetric
Computer Vision, 2016, section 4.2.4. Relevance of single parameters: MacKay, Bayesian
interpolation, 1992.

An estimate d with the prior variance s^2 and the posterior variance v is a share K = 1 - v / s^2 of
what the images say: y = d / K has the variance s^2 + v / K.
"""

import numpy as np

from evercal.geometry import SE3
from evercal.mapping.bundle_equations import INTRINSICS, Linearised, Parameters
from evercal.mapping.bundle_options import BundleOptions
from evercal.mapping.stated_errors import StatedErrors, Variances
from evercal.robot.pose_errors import SharedNoise
from evercal.typing import Array

_COMMON_GROUPS = (slice(0, 3), slice(3, 6))
"""Common translation and rotation: shared parameters that are relevant or not together."""
_SHIFT_GROUP = slice(6, 7)
"""The same: time shift."""
_LENS_GROUPS = (slice(-8, -7), slice(-7, -5), slice(-5, -3), slice(-3, None))
"""The same: focal length, principal point, distortion, and terms that `lens_sigma` alone frees."""
MIN_NOISE = 0.02
"""Lower bound of the standard deviation of whitened residuals."""
MEDIAN_LENGTH = 1.177
"""Median length of two Gaussian axes, in standard deviations."""
RESOLVED_SHARE = 0.03
"""Below this mean share K, errors of stated poses are smaller than what the images resolve."""
UNRESOLVED_SHRINKAGE = 1.5
"""Divisor of the standard deviation of errors that the images do not resolve, in one iteration."""
MOST_SHRINKAGE = 3
"""Largest divisor of the standard deviation of stated poses in one iteration."""
MOST_GROWTH = 2
"""Largest factor on the standard deviation of stated poses in one iteration."""
LEAST_SHARE = 1e-3
"""Lower bound of the share K of a shared parameter, which is a divisor."""
VARIANCE_SHRINKAGE = 16
"""Largest divisor of the variance of shared parameters in one iteration."""
USUAL_OFFSET = 0.05 / 3
"""Prior of the offsets: one pseudo-joint with this offset, in sigmas of the first prior."""
USUAL_LENS = 0.15
"""The same of the intrinsics."""
MOST_LENS = 16.0
"""Largest variance of the intrinsics, in first priors: a wrong file is off by several sigma."""
SYSTEMATIC_WEIGHT = 1.0
"""Weight of the prior of the variance of systematic errors, in directions that the images observe
fully."""
SYSTEMATIC_VARIANCE = 1.0
"""Mean of that prior, in variances of the noise."""
HIDDEN = 4.0
"""Factor on the variance of systematic errors in directions that the images hide: a real arm that
orbits one place moves its mount by 19 mm along the axis (research/trust.md)."""
LEAST_SINGULAR = 1e-6
"""Directions with a smaller singular value, as a share of the largest, do not vary."""


def noise_of(linearised: Linearised) -> float:
    """Robust standard deviation of whitened residuals per axis."""
    squares = (linearised.residual[linearised.valid] ** 2).sum(1)
    if not len(squares):
        return MIN_NOISE
    return max(float(np.sqrt(np.median(squares))) / MEDIAN_LENGTH, MIN_NOISE)


def pose_sigma(
    errors: Array,
    posterior: Array,
    weight: Array,
    sigma: Array,
    options: BundleOptions,
) -> Array:
    """Standard deviations (6,) of stated poses: the mean of d^2 - v K over that of K^2.

    Positions and rotations have one each. `sigma` (6,) are those of the iteration before.

    Args:
        errors: (n, 6) errors d of the stated poses, metres and radians.
        posterior: (n, 6) their posterior variances v.
        weight: (n,) see `student_weights`.
        sigma: (6,) their prior standard deviations s.
        options: Bounds.
    """
    weight = weight[:, None]
    share = 1 - np.minimum(posterior * weight / sigma**2, 1)
    estimated = sigma.copy()
    for axes in (slice(0, 3), slice(3, 6)):
        before = sigma[axes]
        k = share[:, axes]
        if k.mean() < RESOLVED_SHARE:
            estimated[axes] = before / UNRESOLVED_SHRINKAGE
            continue
        excess = errors[:, axes] ** 2 - posterior[:, axes] * k
        excess = (weight * excess).sum()
        independent = np.sqrt(max(excess, 0.0) / (k**2).sum())
        estimated[axes] = independent.clip(
            before / MOST_SHRINKAGE, before * MOST_GROWTH
        )
    least = [options.least_sigma_m, np.deg2rad(options.least_sigma_deg)]
    most = [options.most_sigma_m, options.most_sigma_rad]
    return estimated.clip(np.repeat(least, 3), np.repeat(most, 3))


def student_weights(
    errors: Array,
    sigma: Array,
    tail: float,
) -> Array:
    """Weights (n,) of stated poses whose errors (n, 6) have a Student distribution.

    (tail + 6) / (tail + |d / s|^2) for six axes and `tail` degrees of freedom.
    """
    return (tail + 6) / (tail + ((errors / sigma) ** 2).sum(1))


def shared_variances(
    values: Array,
    rows: Array,
    prior: Array,
    widest: Array,
    joints: slice,
    options: BundleOptions,
) -> Array:
    """Prior variances (15 + k,) of the shared parameters.

    Args:
        values: (15 + k,) estimates d.
        rows: (r, 15 + k) factor of their posterior covariance, rows.T @ rows.
        prior: (15 + k,) their prior variances s^2.
        widest: (15 + k,) their first prior variances.
        joints: Parameters that are offsets of joints.
        options: Bounds.
    """
    posterior = np.einsum("ij,ij->j", rows, rows)
    variances = prior.copy()
    groups = [_SHIFT_GROUP]
    if options.common_stated:
        groups += _COMMON_GROUPS
    if not options.lens_sigma:
        groups += _LENS_GROUPS
    for group in groups:
        variances[group] = group_variance(
            values[group],
            posterior[group],
            prior[group],
            widest[group],
            options,
        )
    alike = []
    if options.lens_sigma:
        alike.append((slice(-INTRINSICS, None), USUAL_LENS, MOST_LENS))
    if joints.stop > joints.start:
        alike.append((joints, USUAL_OFFSET, 1.0))
    for group, usual, most in alike:
        share = common_share(
            values[group],
            posterior[group],
            prior[group],
            widest[group],
            usual,
        )
        variances[group] = min(share, most) * widest[group]
    return variances


def group_variance(
    values: Array,
    posterior: Array,
    prior: Array,
    widest: Array,
    options: BundleOptions,
) -> Array:
    """Prior variances (g,) of parameters that are relevant or not together.

    The mean of y^2 - v / K, if the images require the group: y^2 exceeds its variance v / K by the
    factor `options.relevance`. Otherwise it shrinks to a share of the first prior, `widest`.
    """
    share = np.maximum(1 - np.minimum(posterior / prior, 1), LEAST_SHARE)
    squares = (values / share) ** 2
    noise = posterior / share
    variance = 0.0
    if (squares / noise).mean() > options.relevance:
        variance = (squares - noise).mean()
    variance = np.clip(variance, prior / VARIANCE_SHRINKAGE, widest)
    return np.maximum(variance, options.least_share * widest)


def common_share(
    values: Array,
    posterior: Array,
    prior: Array,
    widest: Array,
    usual: float,
) -> float:
    """Share of `widest` (k,) that is the variance of k parameters which are good or bad together.

    The sum of d^2 over the sum of K, both with a pseudo-parameter of the size `usual`. So a joint
    or a term of the lens that no image constrains is as large as the others.
    """
    constrained = (1 - posterior / prior).clip(0).sum()
    squares = float((values**2 / widest).sum()) + usual**2
    before = float((prior / widest)[0])
    return max(squares / (constrained + 1), before / VARIANCE_SHRINKAGE)


def systematic_covariance(
    stated: SE3,
    errors: StatedErrors,
    parameters: Parameters,
    root: Array,
    variances: Variances,
    least: float,
) -> Array:
    """Covariance of the shared parameters by systematic errors of poses.

    The errors of an arm's joints vary slowly with the pose. They are modelled by errors that are
    linear in the rotation and position of a frame. Their variance t^2 is estimated from the
    residuals, as that of independent errors is: an error in a unit direction that the images
    observe to a share K leaves a residual with the variance K^2 t^2 + K s^2. It is at least `least`
    times s^2.

    Args:
        stated: (n,) stated poses.
        errors: Their errors.
        parameters: Result of the adjustment.
        root: Factor of the parameters' covariance, root.T @ root.
        variances: Priors of the adjustment.
        least: Lower bound of the variance, in variances of the noise.
    """
    basis = _linear_motions(stated, errors.gripper_from_camera)
    weight = np.sqrt(variances.weight)[:, None]
    posterior = np.einsum("nr,kni->kri", basis, weight * errors.of_rows(root))
    residual = basis.T @ (weight * errors.at_origin(parameters)) / variances.sigma
    share = (1 - ((posterior / variances.sigma) ** 2).sum(0)).clip(0)
    ratio = np.zeros(6)
    for axes in (slice(0, 3), slice(3, 6)):
        k = share[:, axes]
        excess = (
            residual[:, axes] ** 2 - k
        ).sum() + SYSTEMATIC_WEIGHT * SYSTEMATIC_VARIANCE
        ratio[axes] = max(excess / ((k**2).sum() + SYSTEMATIC_WEIGHT), least)
    # Response of the shared parameters to an error of each stated pose: (15 + k, n, 6).
    covariance = root[:, 6 * errors.n :].T @ root
    response = weight * errors.of_rows(covariance) / variances.sigma
    scaled = np.einsum("kni,nr->kri", response, basis) * np.sqrt(HIDDEN * ratio)
    rows = scaled.reshape(len(scaled), -1)
    return rows @ rows.T


def by_shared(errors: StatedErrors, root: Array, variances: Variances) -> Array:
    """The part of the covariance of the shared parameters by errors that stated poses share.

    `root` is the factor of the parameters' covariance, root.T @ root.
    """
    covariance = root[:, 6 * errors.n :].T @ root
    response = errors.of_rows(covariance).transpose(1, 2, 0)
    noise = errors.noise(variances)
    effects = noise.shared.reshape(6 * errors.n, noise.shared.shape[2])
    rows = noise.weighted(response).reshape(len(effects), -1).T @ effects
    return rows @ rows.T


def _linear_motions(stated: SE3, gripper_from_camera: SE3) -> Array:
    """(n, r) orthonormal functions of the frame, linear in its rotation and position."""
    rotations = stated.rotation
    turns = (rotations.mean().inv() * rotations).as_rotvec()
    # Of a fixed camera the frame of the map is the gripper: the arm's position is inverse.
    arm = gripper_from_camera.inverse().translation_m
    linear = np.concatenate([turns, stated.translation_m, arm], axis=1)
    basis, size, _ = np.linalg.svd(linear - linear.mean(0), full_matrices=False)
    return basis[:, size > LEAST_SINGULAR * size[0]]


def left_out(errors: Array, rows: Array, noise: SharedNoise) -> Array:
    """Errors (n, 7) of stated poses by the images and the other poses alone.

    The posterior is divided by what each stated pose says: its own prior, given the other errors.

    Args:
        errors: (n, 6) posterior mean of the errors.
        rows: (r, n, 6) factor of their posterior covariance, rows^T rows.
        noise: Their prior.

    Returns:
        (n, 7) of each pose, last its squared Mahalanobis distance, of which 6 is expected.
    """
    pull = noise.weighted(errors[..., None])
    posterior = noise.weighted(rows.transpose(1, 2, 0))
    own = np.linalg.inv(noise.blocks())
    # Of the prior's part of the posterior, as a share of the whole.
    share = own @ posterior @ posterior.transpose(0, 2, 1)
    error = np.linalg.solve(np.eye(6) - share, own @ pull)
    return np.column_stack([error[..., 0], (error * pull).sum((1, 2))])
