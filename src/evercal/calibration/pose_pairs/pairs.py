"""Pose pairs: where the gripper was and where the board lay, image by image."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.geometry import SE3, pose_distance

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

_SAME_ROBOT_M, _SAME_ROBOT_RAD = 1e-4, np.deg2rad(0.01)
_SAME_CAMERA_M, _SAME_CAMERA_RAD = 5e-3, np.deg2rad(0.5)


@dataclass(frozen=True, eq=False)
class PosePairs:
    """n pairs; the board may be any thing whose pose images give: a tag, a map, an SfM model.

    Raises:
        ValueError: Numbers of names and poses that differ.
    """

    names: tuple[str, ...]
    """Of the images, or the rows."""
    base_from_gripper: SE3
    """(n,) from the robot."""
    camera_from_board: SE3
    """(n,) from the images."""
    camera_covariance: Array | None = None
    """(n, 6, 6) of `camera_from_board`: (translation in the camera's axes, metres; rotation about
    the board's axes, radians). Without it the noise is judged from the pairs alone."""
    velocity: Array | None = None
    """(n, 6) of the gripper: metres and radians per second in the axes of the base; given where the
    clocks of robot and camera may differ."""

    def __post_init__(self) -> None:
        counts = {len(self.names), len(self.base_from_gripper), len(self.camera_from_board)}
        if self.camera_covariance is not None:
            counts.add(len(self.camera_covariance))
        if len(counts) != 1:
            raise ValueError(f"pose pairs have as many names as poses, got {sorted(counts)}")

    def __len__(self) -> int:
        """The number of pairs."""
        return len(self.names)

    def __getitem__(self, index: NDArray[np.int64] | Mask) -> Self:
        """Some of the pairs."""
        rows = np.arange(len(self))[index]
        covariance = self.camera_covariance
        return replace(
            self,
            names=tuple(self.names[row] for row in rows),
            base_from_gripper=self.base_from_gripper[rows],
            camera_from_board=self.camera_from_board[rows],
            camera_covariance=None if covariance is None else covariance[rows],
            velocity=None if self.velocity is None else self.velocity[rows],
        )

    def order(self) -> NDArray[np.int64]:
        """(n,) the pairs sorted by what they say, so that no answer depends on their order."""
        keys = [*self.base_from_gripper.translation_m.T, *self.camera_from_board.translation_m.T]
        keys += [*_canonical(self.base_from_gripper).T, *_canonical(self.camera_from_board).T]
        return np.lexsort(keys[::-1])

    def repeats(self, scale_known: bool = True) -> NDArray[np.int64]:
        """(n,) for every pair the first one that says the same; its own number if it is new.

        An arm that stands still and sees the same gives no new pair. One that is said to stand
        still while the camera moved is not taken for a repeat: its pose is stale.
        """
        first = np.arange(len(self))
        positions = self.base_from_gripper.translation_m
        close = KDTree(positions).query_pairs(_SAME_ROBOT_M, output_type="ndarray")
        if len(close) == 0:
            return first
        i, j = np.sort(close, 1).T
        _, turn = pose_distance(self.base_from_gripper[i], self.base_from_gripper[j])
        shift, seen = pose_distance(self.camera_from_board[i], self.camera_from_board[j])
        if not scale_known:
            size = np.linalg.norm(self.camera_from_board.translation_m, axis=1)
            shift = shift / max(float(np.median(size)), 1e-12)
        same = (turn < _SAME_ROBOT_RAD) & (shift < _SAME_CAMERA_M) & (seen < _SAME_CAMERA_RAD)
        np.minimum.at(first, j[same], i[same])
        while (first[first] != first).any():
            first = first[first]
        return first

    def equation(self, mount: Mount, scale_known: bool = True) -> PoseEquation:
        """The equation to solve.

        With the camera on the arm the board is fixed in the base, else in the gripper.
        """
        on_arm, robot = mount == "eye_in_hand", self.base_from_gripper
        equation = PoseEquation.of(
            robot if on_arm else robot.inverse(),
            self.camera_from_board,
            self.camera_covariance,
            scale_known,
            base_is_fixed=on_arm,
        )
        if self.velocity is None:
            return equation
        return replace(equation, velocity=self.velocity if on_arm else _inverse_velocity(self))


def listed(names: Sequence[str], limit: int = 5) -> str:
    """Names for a sentence, the first few of many."""
    shown = ", ".join(names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"


def _inverse_velocity(pairs: PosePairs) -> Array:
    """(n, 6) of the base in the axes of the gripper: how `gripper_from_base` changes."""
    assert pairs.velocity is not None
    shift, spin = np.split(pairs.velocity, 2, 1)
    back = np.swapaxes(pairs.base_from_gripper.rotation_matrix(), 1, 2)
    moved = np.cross(spin, pairs.base_from_gripper.translation_m) - shift
    return np.concatenate([(back @ moved[..., None])[..., 0], -(back @ spin[..., None])[..., 0]], 1)


def _canonical(pose: SE3) -> Array:
    """(n, 4) quaternions with one sign for one rotation."""
    quaternion = pose.rotation_wxyz
    largest = np.take_along_axis(quaternion, np.abs(quaternion).argmax(-1)[:, None], -1)
    return quaternion * np.where(largest < 0, -1.0, 1.0)
