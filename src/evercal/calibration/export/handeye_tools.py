"""Other hand-eye tools: easy_handeye2 (ROS 2), easy_handeye (ROS 1), MoveIt Calibration's samples.

Checked against easy_handeye2's messages and the files of its tests, the readers of easy_handeye
(which take its keys as keyword arguments, so that one too many is an error), and the reader of
MoveIt Calibration's RViz panel.
"""

import yaml

from evercal.calibration.export.request import Export, require_optical
from evercal.calibration.export.ros import transform_message
from evercal.errors import InputError
from evercal.geometry import SE3

_MARKER = "no_marker"
"""Calibrations of ours need none, but a frame must be named."""


def easy_handeye2(export: Export) -> str:
    """A `.calib` for `~/.ros2/easy_handeye2/calibrations`: the message HandeyeCalibration."""
    in_hand = export.calibration.mount == "eye_in_hand"
    base, effector = _robot_frames(export)
    calibration = {
        "parameters": {
            "name": export.name,
            "calibration_type": "eye_in_hand" if in_hand else "eye_on_base",
            "robot_base_frame": base,
            "robot_effector_frame": effector,
            "tracking_base_frame": export.child,
            "tracking_marker_frame": _MARKER,
            "freehand_robot_movement": True,
            "move_group_namespace": "/",
            "move_group": "manipulator",
        },
        "transform": transform_message(export.pose),
    }
    return yaml.safe_dump(calibration, sort_keys=False)


def easy_handeye(export: Export) -> str:
    """A YAML for `~/.ros/easy_handeye`."""
    base, effector = _robot_frames(export)
    message = transform_message(export.pose)
    turned = {f"q{axis}": value for axis, value in message["rotation"].items()}
    calibration = {
        "parameters": {
            "namespace": f"/{export.name}/",
            "move_group_namespace": "/",
            "move_group": "manipulator",
            "eye_on_hand": export.calibration.mount == "eye_in_hand",
            "robot_base_frame": base,
            "robot_effector_frame": effector,
            "tracking_base_frame": export.child,
            "tracking_marker_frame": _MARKER,
        },
        "transformation": {**message["translation"], **turned},
    }
    return yaml.safe_dump(calibration, sort_keys=False)


def moveit_samples(export: Export) -> str:
    """The pose pairs that MoveIt Calibration solves, each 16 numbers row after row, in metres.

    Raises:
        InputError: The pairs are not given, or do not belong together.
    """
    require_optical(export, "moveit_samples")
    robot, target = export.robot_poses, export.target_poses
    if robot is None or target is None:
        raise InputError(
            "moveit_samples holds pose pairs, which a calibration does not; give the gripper's"
            " poses with --robot-poses and the board's poses in the camera with --target-poses"
        )
    camera_from_target = target.poses
    if robot.names and target.names and robot.names != target.names:
        if {*robot.names} != {*target.names}:
            odd = sorted({*robot.names} ^ {*target.names})[0]
            raise InputError(f"moveit_samples: {odd!r} has only one of its two poses; leave it out")
        camera_from_target = target.poses[[target.names.index(name) for name in robot.names]]
    if len(robot) != len(target):
        raise InputError(
            f"moveit_samples: {len(robot)} robot poses and {len(target)} target poses; give one of"
            f" each for every image"
        )
    samples = [
        {"effector_wrt_world": _sixteen(hand), "object_wrt_sensor": _sixteen(board)}
        for hand, board in zip(robot.poses, camera_from_target, strict=True)
    ]
    return yaml.safe_dump(samples, sort_keys=False, default_flow_style=None, width=1000)


def _robot_frames(export: Export) -> tuple[str, str]:
    """Base and gripper; the one that is no parent is needed by these files only."""
    if export.calibration.mount == "eye_in_hand":
        return export.other_frame or "base", export.parent
    return export.parent, export.other_frame or "gripper"


def _sixteen(pose: SE3) -> list[float]:
    return (pose.matrix() + 0.0).ravel().tolist()
