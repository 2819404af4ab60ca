"""Rigid transforms, poses with covariance and the camera model: numpy, float64, no I/O."""

from evercal.geometry.averages import average_poses as average_poses, spread as spread
from evercal.geometry.camera import Camera as Camera, resize_pixels as resize_pixels
from evercal.geometry.se3 import (
    SE3 as SE3,
    cross_matrix as cross_matrix,
    deviations as deviations,
    length_mm_deg as length_mm_deg,
    nearest_rotation as nearest_rotation,
    norms as norms,
    pose_distance as pose_distance,
    pose_distance_mm_deg as pose_distance_mm_deg,
    pose_to_dict as pose_to_dict,
    rotation_error as rotation_error,
    unit_vectors as unit_vectors,
)
from evercal.geometry.uncertain_pose import (
    UncertainPose as UncertainPose,
    axis_deviation as axis_deviation,
    in_parent_axes as in_parent_axes,
)
