"""The gripper poses whose images reduce the uncertainty of a calibration most.

Greedy optimal design: the pose whose expected information lowers a criterion of the covariance most
is added, and so on. D-optimality is the logarithm of the determinant. It does not depend on units,
so it suits poses (Carrillo, Reid and Castellanos, ICRA 2012). A-optimality is the mean variance,
here of a point in front of the camera, so that metres and radians add up.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.view_information import ViewModel
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.geometry.uncertain_pose import axis_deviation

Array = NDArray[np.floating]


@dataclass(frozen=True)
class NextViewOptions:
    """How further views are chosen."""

    criterion: Literal["A", "D"] = "A"
    """Optimality: mean variance (A) or determinant (D) of the covariance."""
    at_m: float = 0.3
    """Distance from the camera at which A-optimality asks for a point's variance, metres."""
    apart_m: float = 0.02
    """Poses nearer than this to another one are left out if also nearer than `apart_deg`: errors
    of an arm repeat where its pose does."""
    apart_deg: float = 4.0
    """See `apart_m`."""


@dataclass(frozen=True, eq=False)
class NextViews:
    """Poses to go to, in order."""

    index: NDArray[np.int64]
    """(k,) index among the reachable poses."""
    poses: SE3
    """(k,) base_from_gripper."""
    sigma_mm: tuple[float, ...]
    """(k + 1,) expected standard deviation per axis: now, and after each pose."""
    sigma_deg: tuple[float, ...]
    """(k + 1,) the same of the rotation."""


def next_views(
    state: ViewModel,
    reachable_poses: SE3,
    count: int = 1,
    recorded: SE3 | None = None,
    options: NextViewOptions | None = None,
) -> NextViews:
    """Choose the next gripper poses among those that the arm can reach.

    Args:
        state: what is known: `HandEyeViews` of a wrist recording, or `FixedCameraViews`.
        reachable_poses: (n,) base_from_gripper.
        count: largest number of poses; fewer if no other pose adds information.
        recorded: (m,) poses that have an image, which are not proposed again.
        options: criterion and distances.

    Raises:
        InputError: No reachable poses.
    """
    options = options or NextViewOptions()
    if len(reachable_poses.shape) != 1 or not len(reachable_poses):
        raise InputError("no reachable poses; give at least one pose that the arm can go to")
    free = np.ones(len(reachable_poses), bool)
    for pose in recorded if recorded is not None else ():
        free &= ~_near(pose, reachable_poses, options)
    added, information = state.added(reachable_poses), state.information
    free &= np.trace(added, axis1=1, axis2=2) > 0
    now = _covariances(information, state.target)
    sigmas, chosen = [axis_deviation(now)], []
    while len(chosen) < count and free.any():
        rows = np.flatnonzero(free)
        covariances = _covariances(information + added[rows], state.target)
        best = int(np.argmin(_cost(covariances, options)))
        chosen.append(int(rows[best]))
        sigmas.append(axis_deviation(covariances[best]))
        information = information + added[chosen[-1]]
        free &= ~_near(reachable_poses[chosen[-1]], reachable_poses, options)
    index = np.array(chosen, np.int64)
    millimetres, degrees = zip(*sigmas, strict=True)
    return NextViews(index, reachable_poses[index], millimetres, degrees)


def _covariances(information: Array, target: slice) -> Array:
    """(..., 6, 6) of the target by matrices (..., N, N)."""
    columns = np.eye(information.shape[-1])[:, target]
    return np.linalg.solve(information, columns)[..., target, :]


def _cost(covariances: Array, options: NextViewOptions) -> Array:
    """(n,) criterion of covariances (n, 6, 6) in the convention of `UncertainPose`."""
    if options.criterion == "D":
        return np.linalg.slogdet(covariances)[1]
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    # A rotation about either axis across the viewing direction moves a point ahead.
    return variances[:, :3].sum(1) + options.at_m**2 * variances[:, 3:].sum(1)


def _near(pose: SE3, others: SE3, options: NextViewOptions) -> NDArray[np.bool_]:
    metres, radians = pose_distance(pose, others)
    return (metres < options.apart_m) & (radians < np.deg2rad(options.apart_deg))
