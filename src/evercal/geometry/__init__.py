"""Pure maths in float64, no files: rigid transforms and the camera."""

from evercal.geometry.camera import Camera as Camera
from evercal.geometry.near import near_training as near_training
from evercal.geometry.pose_covariance import axis_deviation as axis_deviation
from evercal.geometry.pose_covariance import cross_matrix as cross_matrix
from evercal.geometry.pose_covariance import squared_mahalanobis as squared_mahalanobis
from evercal.geometry.pose_covariance import with_translation_by as with_translation_by
from evercal.geometry.se3 import SE3 as SE3
from evercal.geometry.se3 import average_poses as average_poses
from evercal.geometry.se3 import pose_distance as pose_distance
from evercal.geometry.se3 import pose_distance_mm_deg as pose_distance_mm_deg
