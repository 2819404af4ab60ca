"""ROS: tf as a shell line, a launch file or a message; camera_info.

Quaternions are x y z w. Checked against tf2_ros's static_transform_publisher (flags since ROS 2
Humble, nine bare words in ROS 1), the fields of geometry_msgs/TransformStamped, and the calibration
files of camera_calibration_parsers.
"""

import re
import shlex
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml

from evercal.calibration.export.request import Export, require_optical
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.conventions import CONVENTIONS, numbers_from_poses


def static_transform_publisher(export: Export) -> str:
    """One shell line for ROS 2."""
    words = ["ros2", "run", "tf2_ros", "static_transform_publisher", *_flags(export)]
    return shlex.join(words) + "\n"


def launch_py(export: Export) -> str:
    """A launch file for ROS 2."""
    flags = _flags(export)
    pairs = zip(flags[::2], flags[1::2], strict=True)
    arguments = "\n".join(f'                    "{flag}", "{value}",' for flag, value in pairs)
    return f"""# {export.sentence}
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
    """A launch file for ROS 1, as MoveIt Calibration writes its result."""
    numbers = " ".join(map(repr, _numbers(export.pose)))
    words = quoteattr(f"{numbers} {export.parent} {export.child}")
    return f"""<launch>
  <!-- {export.sentence.replace("--", "- -")} x y z qx qy qz qw parent child -->
  <node pkg="tf2_ros" type="static_transform_publisher" name="{_node_name(export)}"
        args={words} />
</launch>
"""


def transform_stamped(export: Export) -> str:
    """geometry_msgs/TransformStamped of ROS 2 as YAML."""
    message = {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": export.parent},
        "child_frame_id": export.child,
        "transform": transform_message(export.pose),
    }
    return f"# {export.sentence}\n" + yaml.safe_dump(message, sort_keys=False)


def camera_info(export: Export) -> str:
    """The camera's intrinsics as camera_calibration and camera_info_manager read them.

    Raises:
        InputError: The calibration holds no intrinsics.
    """
    camera = export.calibration.camera
    if camera is None:
        raise InputError("camera_info: this calibration holds no intrinsics of its camera")
    require_optical(export, "camera_info")
    lens = [*camera.distortion, *(0.0,) * max(0, 5 - len(camera.distortion))]
    model = "plumb_bob" if len(lens) == 5 else "rational_polynomial"
    projection = np.hstack([camera.matrix(), np.zeros((3, 1))])
    info = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": re.sub(r"\W", "_", export.child),
        "camera_matrix": _matrix(camera.matrix()),
        "distortion_model": model,
        "distortion_coefficients": _matrix(np.array([lens])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(projection),
    }
    return yaml.safe_dump(info, sort_keys=False, default_flow_style=None)


def transform_message(pose: SE3) -> dict[str, dict[str, float]]:
    """Fields of geometry_msgs/Transform."""
    numbers = _numbers(pose)
    return {
        "translation": dict(zip("xyz", numbers[:3], strict=True)),
        "rotation": dict(zip("xyzw", numbers[3:], strict=True)),
    }


def _numbers(pose: SE3) -> list[float]:
    """Numbers x y z qx qy qz qw; no minus before a zero."""
    return (numbers_from_poses(pose, CONVENTIONS["xyzw"]) + 0.0).tolist()


def _flags(export: Export) -> list[str]:
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    flags = [
        word
        for name, value in zip(names, _numbers(export.pose), strict=True)
        for word in (name, repr(value))
    ]
    return [*flags, "--frame-id", export.parent, "--child-frame-id", export.child]


def _node_name(export: Export) -> str:
    return re.sub(r"\W", "_", f"{export.parent}_to_{export.child}")


def _matrix(values: np.ndarray) -> dict[str, object]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}
