"""Poses for other programs of the graph: on tf, and with their covariance."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from evercal.geometry import UncertainPose
from evercal.live.ros2.graph import Graph, Publisher, make
from evercal.recordings.formats.bags.file import TF
from evercal.typing import Array

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


class PosePublisher:
    """Publishes the pose of one frame in another on tf and on a topic of its own.

    A static one is on `/tf_static`, latched: programs that start later receive it, too, as long as
    this object lives.
    """

    def __init__(self, parent: str, child: str, static: bool):
        graph = Graph()
        self._parent = parent
        self._child = child
        name = re.sub(r"\W", "_", child)
        tf = "/tf_static" if static else "/tf"
        self.topics = (tf, f"/evercal/{name}/pose")
        """Of the transform, and of the pose with its covariance."""
        self._tf = Publisher(graph, self.topics[0], TF[0], latched=static)
        self._pose = Publisher(graph, self.topics[1], POSE, latched=static)

    def publish(self, pose: UncertainPose, stamp_s: float) -> None:
        """Send a pose that holds at a time, seconds."""
        seconds, nanoseconds = divmod(round(stamp_s * 1e9), 10**9)
        stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        header = make("std_msgs/msg/Header", stamp=stamp, frame_id=self._parent)
        w, *axes = pose.pose.rotation_wxyz.tolist()
        rotation = _numbers("Quaternion", [*axes, w])
        place = pose.pose.translation_m.tolist()
        transform = make(
            "geometry_msgs/msg/TransformStamped",
            header=header,
            child_frame_id=self._child,
            transform=make(
                "geometry_msgs/msg/Transform",
                translation=_numbers("Vector3", place),
                rotation=rotation,
            ),
        )
        self._tf.publish(make(TF[0], transforms=[transform]))
        stated = make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=make(
                "geometry_msgs/msg/Pose",
                position=_numbers("Point", place),
                orientation=rotation,
            ),
            covariance=about_fixed_axes(pose).ravel(),
        )
        self._pose.publish(make(POSE, header=header, pose=stated))


def about_fixed_axes(pose: UncertainPose) -> Array:
    """Covariance (6, 6) as ROS states it: of translation and rotation about the parent's axes."""
    slope = np.eye(6)
    slope[3:, 3:] = pose.pose.rotation_matrix()
    return slope @ pose.covariance @ slope.T


def _numbers(kind: str, values: Sequence[float]) -> Any:
    return make(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", values, strict=False)))
