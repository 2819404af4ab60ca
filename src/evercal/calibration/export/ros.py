"""Formats of ROS: tf, launch files, URDF, easy_handeye and camera_info.

Checked against tf2_ros's static_transform_publisher (flags in ROS 2, nine words in ROS 1),
camera_calibration_parsers, the messages and test files of easy_handeye2, and easy_handeye's reader,
which takes exactly the keys below.
"""

import re
import shlex
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml

from evercal.calibration.export.request import Export

_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")
_MOVE_GROUP = {"move_group_namespace": "/", "move_group": "manipulator"}


def command(export: Export) -> str:
    """Write a shell command for ROS 2."""
    words = ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    return shlex.join([*words, *(word for pair in _flags(export).items() for word in pair)]) + "\n"


def launch_py(export: Export) -> str:
    """Write a launch file for ROS 2."""
    arguments = "\n".join(
        f'                    "{flag}", "{value}",' for flag, value in _flags(export).items()
    )
    return f"""# {export.comment}
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription(
        [
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                name="{_node_name(export)}",
                arguments=[
{arguments}
                ],
            ),
        ]
    )
"""


def ros1_launch(export: Export) -> str:
    """Write a launch file for ROS 1 in the form of MoveIt Calibration."""
    arguments = quoteattr(" ".join([*_numbers(export), export.parent, export.child]))
    return f"""<launch>
  <!-- {_xml_comment(export)} x y z qx qy qz qw parent child -->
  <node pkg="tf2_ros" type="static_transform_publisher" name="{_node_name(export)}"
        args={arguments} />
</launch>
"""


def stamped(export: Export) -> str:
    """Write a geometry_msgs/TransformStamped of ROS 2 as YAML."""
    message = {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": export.parent},
        "child_frame_id": export.child,
        "transform": _transform(export),
    }
    return f"# {export.comment}\n" + yaml.safe_dump(message, sort_keys=False)


def urdf(export: Export) -> str:
    """Write a fixed joint; R = Rz(yaw) Ry(pitch) Rx(roll), about fixed axes, in radians."""
    numbers, name = _numbers(export, "rpy"), _node_name(export, r"\w.-")
    return f"""<joint name={quoteattr(name)} type="fixed">
  <!-- {_xml_comment(export)} -->
  <parent link={quoteattr(export.parent)}/>
  <child link={quoteattr(export.child)}/>
  <origin xyz="{" ".join(numbers[:3])}" rpy="{" ".join(numbers[3:])}"/>
</joint>
"""


def easy_handeye2(export: Export) -> str:
    """Write the message HandeyeCalibration of easy_handeye2."""
    parameters = {
        "name": export.name,
        "calibration_type": "eye_in_hand" if export.in_hand else "eye_on_base",
        **_handeye_frames(export),
        "freehand_robot_movement": True,
        **_MOVE_GROUP,
    }
    message = {"parameters": parameters, "transform": _transform(export)}
    return yaml.safe_dump(message, sort_keys=False)


def easy_handeye(export: Export) -> str:
    """Write the YAML of easy_handeye for ROS 1."""
    parameters = {
        "namespace": f"/{export.name}/",
        **_MOVE_GROUP,
        "eye_on_hand": export.in_hand,
        **_handeye_frames(export),
    }
    transformation = dict(zip(_NAMES, export.numbers(), strict=True))
    calibration = {"parameters": parameters, "transformation": transformation}
    return yaml.safe_dump(calibration, sort_keys=False)


def camera_info(export: Export) -> str:
    """Write the intrinsics for camera_calibration and camera_info_manager."""
    camera = export.camera
    distortion = [*camera.distortion, *(0.0,) * max(0, 5 - len(camera.distortion))]
    info = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": re.sub(r"\W", "_", export.child),
        "camera_matrix": _matrix(camera.matrix()),
        "distortion_model": "plumb_bob" if len(distortion) == 5 else "rational_polynomial",
        "distortion_coefficients": _matrix(np.array([distortion])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.c_[camera.matrix(), np.zeros(3)]),
    }
    return yaml.safe_dump(info, sort_keys=False, default_flow_style=None)


def _numbers(export: Export, convention: str = "xyzw") -> list[str]:
    return [repr(number) for number in export.numbers(convention)]


def _transform(export: Export) -> dict[str, dict[str, float]]:
    x, y, z, *rotation = export.numbers()
    quaternion = dict(zip("xyzw", rotation, strict=True))
    return {"translation": {"x": x, "y": y, "z": z}, "rotation": quaternion}


def _flags(export: Export) -> dict[str, str]:
    flags = {f"--{name}": number for name, number in zip(_NAMES, _numbers(export), strict=True)}
    return {**flags, "--frame-id": export.parent, "--child-frame-id": export.child}


def _handeye_frames(export: Export) -> dict[str, str]:
    other = export.robot_frame
    return {
        "robot_base_frame": other or "base" if export.in_hand else export.parent,
        "robot_effector_frame": export.parent if export.in_hand else other or "gripper",
        "tracking_base_frame": export.child,
        "tracking_marker_frame": "no_marker",  # the tools require a name
    }


def _node_name(export: Export, allowed: str = r"\w") -> str:
    return re.sub(f"[^{allowed}]", "_", f"{export.parent}_to_{export.child}")


def _xml_comment(export: Export) -> str:
    return export.comment.replace("--", "- -")


def _matrix(values: np.ndarray) -> dict[str, object]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}
