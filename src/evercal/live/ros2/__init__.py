"""Cameras, robots and publishers of a running ROS 2 graph, without ROS (extra `ros2`)."""
