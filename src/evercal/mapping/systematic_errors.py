"""Errors of stated poses that vary slowly over a recording, as those of an arm's joints do."""

import numpy as np

from evercal.geometry import SE3
from evercal.mapping.bundle_equations import Parameters
from evercal.mapping.stated_errors import StatedErrors, Variances
from evercal.typing import Array

PRIOR_DIRECTIONS = 1.0
"""Weight of the prior of their variance, in directions that the images observe fully."""
PRIOR_VARIANCE = 1.0
"""Mean of that prior, in variances of the noise."""
HIDDEN = 4.0
"""Factor on their variance in directions that the images hide: a real arm that orbits one place
moves its mount by 19 mm along the axis (research/trust.md)."""
LEAST_SINGULAR = 1e-6
"""Directions with a smaller singular value, as a share of the largest, do not vary."""


def systematic_covariance(
    stated: SE3,
    errors: StatedErrors,
    parameters: Parameters,
    root: Array,
    variances: Variances,
    least: float,
) -> Array:
    """Covariance of common transform, time shift and joints by systematic errors of poses.

    They are modelled by errors that are linear in the rotation and position of a frame. Their
    variance t^2 is estimated from the residuals, as that of independent errors is: an error in a
    unit direction that the images observe to a share K leaves a residual with the variance
    K^2 t^2 + K s^2. It is at least `least` times s^2.

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
        excess = (residual[:, axes] ** 2 - k).sum() + PRIOR_DIRECTIONS * PRIOR_VARIANCE
        ratio[axes] = max(excess / ((k**2).sum() + PRIOR_DIRECTIONS), least)
    # Response of the shared parameters to an error of each stated pose: (7 + k, n, 6).
    covariance = root[:, 6 * errors.n :][:, errors.moving].T @ root
    response = weight * errors.of_rows(covariance) / variances.sigma
    scaled = np.einsum("kni,nr->kri", response, basis) * np.sqrt(HIDDEN * ratio)
    rows = scaled.reshape(len(scaled), -1)
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
