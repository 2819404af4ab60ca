"""Pure maths in float64, no files: rigid transforms and the camera."""

from evercal.geometry.camera import Camera as Camera
from evercal.geometry.near import near_training as near_training
from evercal.geometry.se3 import SE3 as SE3
from evercal.geometry.se3 import average_poses as average_poses
from evercal.geometry.se3 import pose_distance as pose_distance
