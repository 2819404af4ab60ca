"""Cameras, robots and publishers of a running ROS 2 graph, without ROS (extra `ros2`)."""

from evercal.errors import optional_module

for _module in ("cyclonedds.idl", "rosbags.typesys"):
    optional_module(
        _module, "ros2: needs cyclonedds (Python 3.11 to 3.13) and rosbags", "ros2"
    )
