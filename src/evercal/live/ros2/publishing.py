"""Poses for other programs of the graph: on tf, and with their covariance."""

import re

import numpy as np

from evercal.geometry import UncertainPose
from evercal.live.ros2.graph import Graph, header, make
from evercal.recordings.formats.bags.file import TF
from evercal.typing import Array

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


class PosePublisher:
    """Publishes the pose of one frame in another on tf and on a topic of its own.

    A static one is on `/tf_static`, latched: programs that start later receive it, too, as long as
    this object lives.
    """

    def __init__(self, parent: str, child: str, static: bool):
        self._parent = parent
        self._child = child
        name = re.sub(r"\W", "_", child)
        tf = "/tf_static" if static else "/tf"
        self.topics = (tf, f"/evercal/{name}/pose")
        """Of the transform, and of the pose with its covariance."""
        graph = Graph()
        self._tf = graph.publisher(tf, TF[0], static)
        self._pose = graph.publisher(self.topics[1], POSE, static)

    def publish(self, pose: UncertainPose, stamp_s: float) -> None:
        """Send a pose that holds at a time, seconds."""
        own = header(self._parent, stamp_s)
        w, x, y, z = pose.pose.rotation_wxyz.tolist()
        place = pose.pose.translation_m.tolist()
        rotation = make("geometry_msgs/msg/Quaternion", x, y, z, w)
        vector = make("geometry_msgs/msg/Vector3", *place)
        moved = make("geometry_msgs/msg/Transform", vector, rotation)
        child = self._child
        moved = make("geometry_msgs/msg/TransformStamped", own, child, moved)
        self._tf(make(TF[0], [moved]))
        point = make("geometry_msgs/msg/Point", *place)
        plain = make("geometry_msgs/msg/Pose", point, rotation)
        covariance = about_fixed_axes(pose).ravel()
        stated = make("geometry_msgs/msg/PoseWithCovariance", plain, covariance)
        self._pose(make(POSE, own, stated))


def about_fixed_axes(pose: UncertainPose) -> Array:
    """Covariance (6, 6) as ROS states it: of translation and rotation about the parent's axes."""
    slope = np.eye(6)
    slope[3:, 3:] = pose.pose.rotation_matrix()
    return slope @ pose.covariance @ slope.T
