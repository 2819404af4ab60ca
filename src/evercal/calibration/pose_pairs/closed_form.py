"""Closed-form hand-eye calibration, used as a start for the refinement.

The problem has two equivalent forms. With motions A = `gripper_from_gripper` and
B = `camera_from_camera` between two poses, A X = X B. With poses,
`fixed_from_parent @ parent_from_camera @ camera_from_board = fixed_from_board`. The scale of the
camera's translations may be unknown, as in structure from motion with a single camera.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3

Array = NDArray[np.floating]


class RobotWorld(NamedTuple):
    """Solution of the robot-world equation."""

    parent_from_camera: SE3
    fixed_from_board: SE3
    scale: float
    """Metres per unit of the camera's translations."""


def motions(fixed_from_parent: SE3, camera_from_board: SE3) -> tuple[SE3, SE3]:
    """Return `parent_i_from_parent_j` and `camera_i_from_camera_j` for all i < j of n poses."""
    i, j = np.triu_indices(len(fixed_from_parent), 1)
    a = fixed_from_parent[i].inverse() @ fixed_from_parent[j]
    b = camera_from_board[i] @ camera_from_board[j].inverse()
    return a, b


def park(a: SE3, b: SE3, scale_known: bool = True) -> tuple[SE3, float]:
    """Solve A X = X B by aligning rotation axes.

    F. Park and B. Martin, Robot sensor calibration: solving AX = XB on the Euclidean group, 1994.
    The axes are weighted by the sine of the angle instead of the angle. The logarithm of a rotation
    by 180 degrees has no sign, and motions near 180 degrees would have the largest weight.

    Args:
        a: (m,) motions of the parent, m >= 2 with axes that are not parallel.
        b: (m,) motions of the camera.
        scale_known: Whether the translations of `b` are in metres.

    Returns:
        `parent_from_camera` and the scale, metres per unit of the translations of `b`.
    """
    rotation = Rotation.align_vectors(_sine_axes(a), _sine_axes(b))[0]
    rotated = rotation.apply(b.translation_m)
    system = a.rotation_matrix() - np.eye(3)
    right_side = -a.translation_m
    if scale_known:
        right_side = right_side + rotated
    else:
        system = np.concatenate([system, -rotated[:, :, None]], 2)
    unknowns = system.shape[-1]
    solution = np.linalg.lstsq(system.reshape(-1, unknowns), right_side.ravel(), rcond=None)[0]
    return _se3(rotation, solution[:3]), 1.0 if scale_known else float(solution[3])


def shah(fixed_from_parent: SE3, camera_from_board: SE3, scale_known: bool = True) -> RobotWorld:
    """Solve the robot-world equation of three or more poses, linearly in both rotations.

    M. Shah, Solving the robot-world/hand-eye calibration problem using the Kronecker product,
    2013. Rotations by 180 degrees need no special treatment.
    """
    n = len(fixed_from_parent)
    robot, camera = fixed_from_parent.rotation_matrix(), camera_from_board.rotation_matrix()
    # vec(F X C) = (C' kron F) vec(X), with stacked columns.
    kronecker = np.einsum("nlk,nij->kilj", camera, robot).reshape(9, 9)
    left, _, right = np.linalg.svd(kronecker)
    parent_from_camera = _nearest_rotation(right[0].reshape(3, 3).T)
    fixed_from_board = _nearest_rotation(left[:, 0].reshape(3, 3).T)
    # Translation of F X C: R_F t_X + s R_F R_X t_C + t_F = t_Z.
    fixed_from_camera = robot @ parent_from_camera.as_matrix()
    rotated = np.einsum("nij,nj->ni", fixed_from_camera, camera_from_board.translation_m)
    columns = [robot, -np.broadcast_to(np.eye(3), (n, 3, 3))]
    right_side = -fixed_from_parent.translation_m
    if scale_known:
        right_side = right_side - rotated
    else:
        columns.append(rotated[:, :, None])
    system = np.concatenate(columns, 2).reshape(3 * n, -1)
    solution = np.linalg.lstsq(system, right_side.ravel(), rcond=None)[0]
    return RobotWorld(
        _se3(parent_from_camera, solution[:3]),
        _se3(fixed_from_board, solution[3:6]),
        1.0 if scale_known else float(solution[6]),
    )


def _sine_axes(pose: SE3) -> Array:
    """Return the rotation axes times the sine of the angle, (m, 3)."""
    quaternion = pose.rotation_wxyz
    return 2.0 * quaternion[..., :1] * quaternion[..., 1:]


def _nearest_rotation(matrix: Array) -> Rotation:
    """Return the rotation nearest to a matrix that is a multiple of a rotation, of either sign."""
    left, _, right = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return Rotation.from_matrix(left @ right)


def _se3(rotation: Rotation, translation: Array) -> SE3:
    quaternion = rotation.as_quat(canonical=True, scalar_first=True)
    return SE3(quaternion, np.asarray(translation, dtype=np.float64))
