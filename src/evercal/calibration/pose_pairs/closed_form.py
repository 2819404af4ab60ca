"""Hand-eye and robot-world transforms in closed form: starts for the refinement, no answers.

Two equations say the same. With motions between two poses, A = `gripper_from_gripper` and
B = `camera_from_camera`, A X = X B; with poses, `fixed_from_parent @ parent_from_camera
@ camera_from_board = fixed_from_board`. The camera's translations may be known up to one common
scale only, as structure from motion of a single camera gives them.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3

Array = NDArray[np.floating]


def motions(fixed_from_parent: SE3, camera_from_board: SE3) -> tuple[SE3, SE3]:
    """All pairs i < j: how the parent moved and how the camera moved between two poses.

    Args:
        fixed_from_parent: (n,) poses of the frame that the camera is fixed to.
        camera_from_board: (n,) poses of the board, which is fixed in `fixed`.

    Returns:
        (n (n - 1) / 2,) `parent_i_from_parent_j` and `camera_i_from_camera_j`.
    """
    i, j = np.triu_indices(len(fixed_from_parent), 1)
    a = fixed_from_parent[i].inverse() @ fixed_from_parent[j]
    b = camera_from_board[i] @ camera_from_board[j].inverse()
    return a, b


def park(a: SE3, b: SE3, scale_known: bool = True) -> tuple[SE3, float]:
    """X and the scale of A X = X B by alignment of rotation axes.

    F. Park and B. Martin, Robot sensor calibration: solving AX = XB on the Euclidean group, 1994.
    The axes are weighted by the sine of the angle instead of the angle: the logarithm of a half
    turn has no sign, and a pair that is close to one would count most.

    Args:
        a: (m,) motions of the parent, m >= 2 with axes that are not parallel.
        b: (m,) motions of the camera.
        scale_known: whether the translations of `b` are in metres.

    Returns:
        `parent_from_camera` (single) and metres per unit of the translations of `b`.

    Raises:
        ValueError: fewer than two motions, or numbers of motions that differ.
    """
    _require(a, b)
    rotation = Rotation.align_vectors(_sine_axes(a), _sine_axes(b))[0]
    return _with_translation(rotation, a, b, scale_known)


def daniilidis(a: SE3, b: SE3) -> SE3:
    """X of A X = X B by dual quaternions, rotation and translation at once.

    K. Daniilidis, Hand-eye calibration using dual quaternions, 1999. The scale must be known.

    Args:
        a: (m,) motions of the parent, m >= 2 with axes that are not parallel.
        b: (m,) motions of the camera, translations in metres.

    Returns:
        `parent_from_camera` (single).

    Raises:
        ValueError: fewer than two motions, or numbers of motions that differ.
    """
    _require(a, b)
    (real_a, dual_a), (real_b, dual_b) = _dual_quaternion(a), _dual_quaternion(b)
    # The scalar parts of conjugate motions are equal; signs of quaternions are free, so choose.
    flip = np.where(np.sum(real_a[:, :1] * real_b[:, :1], 1, keepdims=True) < 0, -1.0, 1.0)
    real_b, dual_b = real_b * flip, dual_b * flip
    real = _left(real_a) - _right(real_b)
    dual = _left(dual_a) - _right(dual_b)
    system = np.zeros((len(a), 8, 8))
    system[:, :4, :4] = system[:, 4:, 4:] = real
    system[:, 4:, :4] = dual
    null = np.linalg.svd(system.reshape(-1, 8))[2][-2:]
    u, v = null[:, :4], null[:, 4:]
    # Of the plane s u1 + t u2 that solves the system, the unit dual quaternion: real . dual = 0.
    roots = np.roots([u[0] @ v[0], u[0] @ v[1] + u[1] @ v[0], u[1] @ v[1]]).real
    weights = [np.array([root, 1.0]) for root in roots] or [np.array([1.0, 0.0])]
    weight = max(weights, key=lambda w: float(np.sum((w @ u) ** 2) / (w @ w)))
    quaternion, moment = weight @ u, weight @ v
    length = np.linalg.norm(quaternion)
    quaternion, moment = quaternion / length, moment / length
    conjugate = quaternion * np.array([1.0, -1.0, -1.0, -1.0])
    return SE3(quaternion, 2.0 * (_right(conjugate[None])[0] @ moment)[1:])


def shah(
    fixed_from_parent: SE3, camera_from_board: SE3, scale_known: bool = True
) -> tuple[SE3, SE3, float]:
    """X, Z and the scale of the robot-world equation, linear in both rotations at once.

    M. Shah, Solving the robot-world/hand-eye calibration problem using the Kronecker product,
    2013. Half turns need no care here.

    Args:
        fixed_from_parent: (n,), n >= 3.
        camera_from_board: (n,).
        scale_known: whether the translations of `camera_from_board` are in metres.

    Returns:
        `parent_from_camera` (single), `fixed_from_board` (single), metres per unit.

    Raises:
        ValueError: fewer than three poses, or numbers of poses that differ.
    """
    n = len(fixed_from_parent)
    if n < 3 or len(camera_from_board) != n:
        raise ValueError(
            f"Shah's method takes three poses or more of robot and camera, got {n} and"
            f" {len(camera_from_board)}"
        )
    robot, camera = fixed_from_parent.rotation_matrix(), camera_from_board.rotation_matrix()
    # vec(F X C) = (C' kron F) vec(X), with columns stacked.
    kronecker = np.einsum("nlk,nij->kilj", camera, robot).reshape(9, 9)
    left, _, right = np.linalg.svd(kronecker)
    parent_from_camera = _nearest_rotation(right[0].reshape(3, 3).T)
    fixed_from_board = _nearest_rotation(left[:, 0].reshape(3, 3).T)
    # F X's translation: R_F t_X + s R_F R_X t_C + t_F = t_Z.
    turned = robot @ parent_from_camera.as_matrix()
    moved = np.einsum("nij,nj->ni", turned, camera_from_board.translation_m)
    columns = [robot, -np.broadcast_to(np.eye(3), (n, 3, 3))]
    right_side = -fixed_from_parent.translation_m
    if scale_known:
        right_side = right_side - moved
    else:
        columns.append(moved[:, :, None])
    system = np.concatenate(columns, 2).reshape(3 * n, -1)
    found = np.linalg.lstsq(system, right_side.ravel(), rcond=None)[0]
    scale = 1.0 if scale_known else float(found[6])
    return _se3(parent_from_camera, found[:3]), _se3(fixed_from_board, found[3:6]), scale


def _require(a: SE3, b: SE3) -> None:
    if len(a) < 2 or len(a) != len(b):
        raise ValueError(
            f"two motions or more of robot and camera are needed, got {len(a)} and {len(b)}"
        )


def _sine_axes(pose: SE3) -> Array:
    """(m, 3) rotation axis times the sine of the angle: the skew part of the rotation."""
    quaternion = pose.rotation_wxyz
    return 2.0 * quaternion[..., :1] * quaternion[..., 1:]


def _with_translation(rotation: Rotation, a: SE3, b: SE3, scale_known: bool) -> tuple[SE3, float]:
    """The translation (and scale) of A X = X B where the rotation of X is known."""
    moved = rotation.apply(b.translation_m)
    system = a.rotation_matrix() - np.eye(3)
    right_side = -a.translation_m
    if scale_known:
        right_side = right_side + moved
    else:
        system = np.concatenate([system, -moved[:, :, None]], 2)
    unknowns = system.shape[-1]
    found = np.linalg.lstsq(system.reshape(-1, unknowns), right_side.ravel(), rcond=None)[0]
    return _se3(rotation, found[:3]), 1.0 if scale_known else float(found[3])


def _nearest_rotation(matrix: Array) -> Rotation:
    """Of a matrix that is a rotation times any factor, negative ones too."""
    left, _, right = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return Rotation.from_matrix(left @ right)


def _se3(rotation: Rotation, translation: Array) -> SE3:
    return SE3(
        rotation.as_quat(canonical=True, scalar_first=True),
        np.asarray(translation, dtype=np.float64),
    )


def _dual_quaternion(pose: SE3) -> tuple[Array, Array]:
    """(m, 4) real and dual part, q and t q / 2."""
    translation = np.concatenate([np.zeros((len(pose), 1)), pose.translation_m], 1)
    dual = 0.5 * np.einsum("nij,nj->ni", _left(translation), pose.rotation_wxyz)
    return pose.rotation_wxyz, dual


def _left(q: Array) -> Array:
    """(n, 4, 4) matrices of the product with (n, 4) quaternions w, x, y, z on the left."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w], -1).reshape(-1, 4, 4)


def _right(q: Array) -> Array:
    """The same with the quaternions on the right."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack([w, -x, -y, -z, x, w, z, -y, y, -z, w, x, z, y, -x, w], -1).reshape(-1, 4, 4)
