"""Rigid transforms, poses with covariance and the camera model: numpy, float64, no I/O."""

from evercal.geometry.averages import average_poses as average_poses
from evercal.geometry.averages import spread as spread
from evercal.geometry.camera import Camera as Camera
from evercal.geometry.camera import resize_pixels as resize_pixels
from evercal.geometry.se3 import SE3 as SE3
from evercal.geometry.se3 import cross_matrix as cross_matrix
from evercal.geometry.se3 import deviations as deviations
from evercal.geometry.se3 import length_mm_deg as length_mm_deg
from evercal.geometry.se3 import norms as norms
from evercal.geometry.se3 import pose_distance as pose_distance
from evercal.geometry.se3 import pose_distance_mm_deg as pose_distance_mm_deg
from evercal.geometry.se3 import pose_to_dict as pose_to_dict
from evercal.geometry.se3 import rotation_error as rotation_error
from evercal.geometry.se3 import unit_vectors as unit_vectors
from evercal.geometry.uncertain_pose import UncertainPose as UncertainPose
from evercal.geometry.uncertain_pose import axis_deviation as axis_deviation
from evercal.geometry.uncertain_pose import in_parent_axes as in_parent_axes
