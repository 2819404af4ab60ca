"""Words that arguments and answers take, as types that editors and the command line know."""

from typing import Literal

MountName = Literal["eye_to_hand", "eye_in_hand"]
"""Mount of a camera: fixed beside the arm, or on the gripper."""
Status = Literal["ok", "uncertain", "ambiguous", "unknown_scene", "failed"]
"""Outcome of locating an image."""
CameraModel = Literal["pinhole", "fisheye"]
"""Projection of a camera; fisheye is OpenCV's."""
BoardKind = Literal[
    "chessboard",
    "charuco",
    "apriltag",
    "aprilgrid",
    "arucogrid",
    "circles",
    "acircles",
]
"""Printed board: aprilgrid is Kalibr's, arucogrid OpenCV's GridBoard; acircles has shifted rows."""
OnClash = Literal["refuse", "rename", "skip", "replace"]
"""What a merge of maps does with a scene whose name is taken."""
ArmClass = Literal["industrial", "cobot", "hobby"]
"""How accurate the joints of an arm are when it leaves the factory."""
Motors = Literal["feetech", "dynamixel"]
"""Motors of an arm of LeRobot."""
Preset = Literal["fast", "demo", "bench", "converged", "paper"]
"""Amount of training of a network."""
ConventionName = Literal[
    "wxyz", "xyzw", "tum", "abb", "ur", "rpy", "kuka", "fanuc", "yaskawa", "staubli",
    "kawasaki", "matrix", "franka", "mitsubishi", "denso", "techman", "jaka", "dobot",
    "aubo", "xarm", "epson", "nachi", "doosan", "comau", "universal_robots", "motoman",
]  # fmt: skip
"""Names of pose conventions without modifiers, but for fixed_xyz, moving_zyx and the like."""
ExportFormat = Literal[
    "easy_handeye2",
    "easy_handeye",
    "moveit_samples",
    "static_transform_publisher",
    "launch_py",
    "ros1_launch",
    "transform_stamped",
    "camera_info",
    "urdf",
    "opencv",
    "csv",
    "npy",
    "json",
    "tum",
    "colmap",
    "nerfstudio",
    "mujoco",
    "isaac",
    "sapien",
    "pybullet",
    "blender",
    "zivid",
    "ur",
    "kuka",
    "abb",
    "fanuc",
    "yaskawa",
    "staubli",
    "franka",
    "joint_offsets",
    "corrected_urdf",
    "lerobot",
]
"""Format of an exported calibration; the last three describe the arm."""
FormatName = Literal[
    "generic",
    "7scenes",
    "12scenes",
    "cambridge",
    "nerfstudio",
    "colmap",
    "wrist",
    "lerobot",
    "rosbag",
]
"""Format of a recording."""
