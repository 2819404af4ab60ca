"""A pose with its covariance.

A covariance (6, 6) of `parent_from_child` is that of a small error (dt, dr): the translation is off
by dt, metres, along the axes of the parent; the rotation R is R Exp(dr), radians, about the axes of
the child.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from evercal.geometry.se3 import SE3, cross_matrix
from evercal.typing import Array, Pair


@dataclass(frozen=True, eq=False)
class UncertainPose:
    """A rigid transform with a Gaussian error (Barfoot and Furgale, IEEE T-RO 2014)."""

    pose: SE3
    """parent_from_child, a single transform."""
    covariance: Array
    """(6, 6) of translation in the parent frame (m) and rotation about child axes (rad)."""

    def __post_init__(self) -> None:
        covariance = np.asarray(self.covariance, float)
        if self.pose.shape or covariance.shape != (6, 6):
            raise ValueError(
                f"an uncertain pose is one SE3 with a covariance (6, 6), got {self.pose.shape} and"
                f" {covariance.shape}"
            )
        object.__setattr__(self, "covariance", (covariance + covariance.T) / 2)

    @classmethod
    def exact(cls, pose: SE3) -> "UncertainPose":
        """A pose without error."""
        return cls(pose, np.zeros((6, 6)))

    def __matmul__(self, other: "UncertainPose | SE3") -> "UncertainPose":
        """`a_from_b @ b_from_c` is `a_from_c`; the errors of both are independent."""
        if isinstance(other, SE3):
            other = UncertainPose.exact(other)
        if not isinstance(other, UncertainPose):
            return NotImplemented
        rotation = self.pose.rotation_matrix()
        by_first = np.eye(6)
        by_second = np.eye(6)
        by_first[:3, 3:] = -rotation @ cross_matrix(other.pose.translation_m)
        by_first[3:, 3:] = other.pose.rotation_matrix().T
        by_second[:3, :3] = rotation
        covariance = by_first @ self.covariance @ by_first.T
        return UncertainPose(
            self.pose @ other.pose,
            covariance + by_second @ other.covariance @ by_second.T,
        )

    def __rmatmul__(self, other: SE3) -> "UncertainPose":
        """An exact transform on the left."""
        return UncertainPose.exact(other) @ self

    def inverse(self) -> "UncertainPose":
        """child_from_parent."""
        inverse = self.pose.inverse()
        rotation = self.pose.rotation_matrix()
        slope = np.zeros((6, 6))
        slope[:3, :3] = -rotation.T
        slope[:3, 3:] = cross_matrix(inverse.translation_m)
        slope[3:, 3:] = -rotation
        return UncertainPose(inverse, slope @ self.covariance @ slope.T)

    def squared_mahalanobis(self, truth: SE3) -> float:
        """Squared distance of the true pose in units of the covariance.

        It has a chi-squared distribution with six degrees of freedom if the covariance is right.
        """
        shift = truth.translation_m - self.pose.translation_m
        error = np.concatenate([shift, (self.pose.inverse() @ truth).log()[3:]])
        # A pose from few points can have a singular covariance; its null space is left out.
        return float(error @ np.linalg.pinv(self.covariance) @ error)

    def point_covariance(self, point_m: ArrayLike) -> Array:
        """Covariance (3, 3), in the parent frame, of a point (3,) that is exact in the child frame.

        With the error (dt, dr) of the pose it moves by dt + R (dr x point).
        """
        slope = np.zeros((3, 6))
        slope[:, :3] = np.eye(3)
        slope[:, 3:] = -self.pose.rotation_matrix() @ cross_matrix(point_m)
        return slope @ self.covariance @ slope.T

    def point_sigma_mm(self, point_m: ArrayLike) -> float:
        """Standard deviation of a point per axis, millimetres, see `point_covariance`."""
        return 1000 * float(np.sqrt(np.trace(self.point_covariance(point_m)) / 3))

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of the translation per axis, millimetres."""
        return axis_deviation(self.covariance)[0]

    @property
    def sigma_deg(self) -> float:
        """Standard deviation of the rotation per axis, degrees."""
        return axis_deviation(self.covariance)[1]


def axis_deviation(covariance: ArrayLike) -> Pair:
    """Standard deviation per axis, millimetres and degrees: root mean squares of three axes."""
    variance = np.diag(np.asarray(covariance, float))
    metres = np.sqrt(variance[:3].mean())
    radians = np.sqrt(variance[3:].mean())
    return 1000 * float(metres), float(np.rad2deg(radians))


def in_parent_axes(rotation: Array, covariance: Array) -> Array:
    """Covariance (6, 6) with its translation part rotated from child axes to the parent's."""
    slope = np.eye(6)
    slope[:3, :3] = rotation
    return np.asarray(slope @ covariance @ slope.T, float)
