"""The writers of all formats: ROS, matrices, robot controllers, and a pose for every image.

Checked against tf2_ros's static_transform_publisher (flags in ROS 2, nine words in ROS 1),
camera_calibration_parsers, the messages and test files of easy_handeye2, easy_handeye's reader
(which takes exactly the keys below), Zivid's Python samples, pycolmap, and nerfstudio's parser and
`Cameras`. The conventions of robots are in `evercal.recordings.poses.conventions`.
"""

import io
import json
import re
from collections.abc import Callable

import numpy as np
import yaml

from evercal.calibration.export.request import Export, pose_numbers
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.typing import JsonObject, Strings

_NUMBER_OF_OTHERS = re.compile(
    r"(?<=: )(\d+[eE][-+]?\d+|\d+\.\d*[eE]\d+|0o[0-7]+)$", re.MULTILINE
)
"""Texts that are numbers in YAML 1.2, but not to PyYAML, which writes 1.0e-05."""
_MOVE_GROUP = {"move_group_namespace": "/", "move_group": "manipulator"}


def _text(
    convention: str, template: str, number: Callable[[float], str] = repr
) -> Callable[[Export], str]:
    """Return the writer of a text with the pose as numbers; frame names need no quotes."""

    def write(export: Export) -> str:
        frames = f"{export.parent}_to_{export.child}"
        return template.format(
            *map(number, export.numbers(convention)),
            parent=export.parent,
            child=export.child,
            # In ROS 1, a node's name begins with a letter.
            node=re.sub(r"^(?=[\d_])", "tf_", re.sub(r"\W", "_", frames)),
            joint=re.sub(r"[^\w.-]", "_", frames),
            comment=export.comment,
            xml=re.sub("-(?=-)", "- ", export.comment),
        )

    return write


command = _text(
    "xyzw",
    "ros2 run tf2_ros static_transform_publisher --x {} --y {} --z {} --qx {} --qy {} --qz {}"
    " --qw {} --frame-id {parent} --child-frame-id {child}\n",
)
launch_py = _text(
    "xyzw",
    """# {comment}
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription(
        [
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                name="{node}",
                arguments=[
                    "--x", "{}",
                    "--y", "{}",
                    "--z", "{}",
                    "--qx", "{}",
                    "--qy", "{}",
                    "--qz", "{}",
                    "--qw", "{}",
                    "--frame-id", "{parent}",
                    "--child-frame-id", "{child}",
                ],
            ),
        ]
    )
""",
)
ros1_launch = _text(
    "xyzw",
    """<launch>
  <!-- {xml} x y z qx qy qz qw parent child -->
  <node pkg="tf2_ros" type="static_transform_publisher" name="{node}"
        args="{} {} {} {} {} {} {} {parent} {child}" />
</launch>
""",
)
# R = Rz(yaw) Ry(pitch) Rx(roll), about fixed axes, in radians.
urdf = _text(
    "rpy",
    """<joint name="{joint}" type="fixed">
  <!-- {xml} -->
  <parent link="{parent}"/>
  <child link="{child}"/>
  <origin xyz="{} {} {}" rpy="{} {} {}"/>
</joint>
""",
)
csv = _text("matrix", "{},{},{},{}\n" * 4)
# Column by column in metres, like libfranka's O_T_EE.
franka = _text("franka", f"[{', '.join(['{}'] * 16)}]\n")


def _nine(value: float) -> str:
    # Some controllers cannot parse exponents.
    return f"{round(value, 9) + 0.0:.9f}"


ur = _text("ur", "# {comment}\np[{}, {}, {}, {}, {}, {}]\n", _nine)
kuka = _text("kuka", "; {comment}\n{{X {}, Y {}, Z {}, A {}, B {}, C {}}}\n", _nine)
abb = _text("abb", "! {comment}\n[[{},{},{}],[{},{},{},{}]]\n", _nine)
fanuc = _text("fanuc", "# {comment}\nX Y Z W P R\n{} {} {} {} {} {}\n", _nine)
yaskawa = _text("yaskawa", "# {comment}\nX Y Z Rx Ry Rz\n{} {} {} {} {} {}\n", _nine)
staubli = _text("staubli", "# {comment}\nX Y Z RX RY RZ\n{} {} {} {} {} {}\n", _nine)


def _yaml(record: object, flow: bool | None = False, width: int = 80) -> str:
    text = yaml.safe_dump(record, sort_keys=False, default_flow_style=flow, width=width)
    return _NUMBER_OF_OTHERS.sub(r'"\1"', text)


def stamped(export: Export) -> str:
    """Write a geometry_msgs/TransformStamped of ROS 2 as YAML."""
    message = {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": export.parent},
        "child_frame_id": export.child,
        "transform": _transform(export),
    }
    return f"# {export.comment}\n" + _yaml(message)


def easy_handeye2(export: Export) -> str:
    """Write the message HandeyeCalibration of easy_handeye2."""
    parameters = {
        "name": export.name,
        "calibration_type": ("eye_on_base", "eye_in_hand")[export.in_hand],
        **_handeye_frames(export),
        "freehand_robot_movement": True,
        **_MOVE_GROUP,
    }
    message = {"parameters": parameters, "transform": _transform(export)}
    return f"# {export.comment}\n" + _yaml(message)


def easy_handeye(export: Export) -> str:
    """Write the YAML of easy_handeye for ROS 1."""
    parameters = {
        "namespace": f"/{export.name}/",
        **_MOVE_GROUP,
        "eye_on_hand": export.in_hand,
        **_handeye_frames(export),
    }
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    transformation = dict(zip(names, export.numbers(), strict=True))
    calibration = {"parameters": parameters, "transformation": transformation}
    return f"# {export.comment}\n" + _yaml(calibration)


def camera_info(export: Export) -> str:
    """Write the intrinsics for camera_calibration and camera_info_manager."""
    camera = export.camera
    distortion = [*camera.distortion]
    if camera.model == "pinhole":
        distortion += [0.0] * (5 - len(distortion))
    models = {4: "equidistant", 5: "plumb_bob", 8: "rational_polynomial"}
    info = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": re.sub(r"\W", "_", export.child),
        "camera_matrix": _matrix(camera.matrix()),
        "distortion_model": models[len(distortion)],
        "distortion_coefficients": _matrix(np.array([distortion])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.c_[camera.matrix(), np.zeros(3)]),
    }
    return _yaml(info, None)


def _transform(export: Export) -> dict[str, dict[str, float]]:
    x, y, z, *rotation = export.numbers()
    quaternion = dict(zip("xyzw", rotation, strict=True))
    return {"translation": {"x": x, "y": y, "z": z}, "rotation": quaternion}


def _handeye_frames(export: Export) -> dict[str, str]:
    names = export.calibration.frames
    return {
        "robot_base_frame": names.base,
        "robot_effector_frame": names.gripper,
        "tracking_base_frame": export.child,
        "tracking_marker_frame": "no_marker",  # the tools require a name
    }


def _matrix(values: np.ndarray) -> JsonObject:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}


def opencv(export: Export) -> str:
    """Write rvec and tvec for cv2.projectPoints in the format of cv2.FileStorage.

    They map points from the parent frame to the camera, the inverse of every other format.
    """
    import cv2

    camera_from_parent = export.pose.inverse()
    rotation = camera_from_parent.rotation
    mode = (
        cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    )
    storage = cv2.FileStorage(".yml", mode)
    storage.writeComment(
        f"rvec, tvec take points from {export.parent} to {export.child}, metres;"
        f" {export.comment}"
    )
    storage.write("rvec", rotation.as_rotvec().reshape(3, 1))
    storage.write("tvec", camera_from_parent.translation_m.reshape(3, 1))
    camera = export.calibration.camera
    if camera:
        storage.write("image_width", camera.width)
        storage.write("image_height", camera.height)
        storage.write("camera_matrix", camera.matrix())
        if camera.model == "fisheye":  # as in OpenCV's example of calibration
            storage.write("fisheye_model", 1)
        distortion = camera.distortion or (0.0,) * 5
        storage.write("distortion_coefficients", np.array(distortion).reshape(-1, 1))
    return storage.releaseAndGetString()


def npy(export: Export) -> bytes:
    """Write the same matrix as a numpy array (4, 4) of float64."""
    file = io.BytesIO()
    np.save(file, export.pose.matrix() + 0.0)
    return file.getvalue()


def as_json(export: Export) -> str:
    """Write matrix, quaternion, covariance and frame names; `read_robot_poses` reads them."""
    return (
        json.dumps(export.calibration.transform_to_dict(), indent=1, allow_nan=False)
        + "\n"
    )


def zivid(export: Export) -> str:
    """Write the 4x4 matrix in millimetres as YAML."""
    rows = np.reshape(export.numbers("matrix:mm"), (4, 4)).tolist()
    record = {
        "__version__": {"serializer": 1, "data": 1},
        "FloatMatrix": {"Data": rows},
    }
    return _yaml(record, None)


def _image_poses(export: Export) -> tuple[Strings, SE3]:
    robot = export.robot_poses
    if not export.in_hand:
        used = tuple(image.name for image in export.calibration.images if image.used)
        names = used or (f"{export.child.replace('/', '_')}.png",)
        return names, SE3.stack([export.pose] * len(names))
    if robot is None:
        raise InputError(
            "the pose of a camera on the arm changes with each image; give the gripper's poses with"
            " `robot_poses`"
        )
    names = robot.names or tuple(f"{i:06d}.png" for i in range(len(robot)))
    return names, robot.poses @ export.pose


def tum(export: Export) -> str:
    """Write lines of stamp, translation in metres, quaternion x y z w: base_from_camera."""
    rows = pose_numbers(_image_poses(export)[1])
    robot = export.robot_poses
    stamps = np.arange(len(rows), dtype=float)
    if not export.in_hand:
        stamps = stamps[:1]
        rows = rows[:1]
    elif robot is not None and robot.stamps_s is not None:
        stamps = robot.stamps_s
    lines = [" ".join(map(repr, row)) for row in np.c_[stamps, rows].tolist()]
    return "\n".join(["# timestamp tx ty tz qx qy qz qw", *lines, ""])


def colmap(export: Export) -> dict[str, str]:
    """Write a sparse model without points: camera_from_base, quaternion w x y z."""
    camera = export.camera
    names, poses = _image_poses(export)
    lines = []
    rows = pose_numbers(poses, "wxyz:inverse").tolist()
    for i, (name, row) in enumerate(zip(names, rows, strict=True)):
        if len(name.split()) != 1:
            raise InputError(f"image name {name!r} contains a blank; rename the image")
        pose = " ".join(map(repr, [*row[3:], *row[:3]]))
        lines += [f"{i + 1} {pose} 1 {name}", ""]
    model = "PINHOLE"
    parameters = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    if camera.model == "fisheye":
        model = "OPENCV_FISHEYE"
        parameters += camera.distortion
    elif any(camera.distortion) and len(camera.distortion) == 4:
        model = "OPENCV"
        parameters += camera.distortion
    elif any(camera.distortion):
        model = "FULL_OPENCV"
        parameters += camera.coefficients
    intrinsics = " ".join(map(repr, parameters))
    return {
        "cameras.txt": "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 {model} {camera.width} {camera.height} {intrinsics}\n",
        "images.txt": "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        "# POINTS2D[] as (X, Y, POINT3D_ID)\n" + "\n".join([*lines, ""]),
        "points3D.txt": "# no points\n",
    }


def nerfstudio(export: Export) -> str:
    """Write transforms.json: base_from_camera with camera axes x right, y up, z back."""
    camera = export.camera
    names, poses = _image_poses(export)
    model = "OPENCV"
    terms = ("k1", "k2", "p1", "p2", "k3")
    if camera.model == "fisheye":
        model = "OPENCV_FISHEYE"
        terms = ("k1", "k2", "k3", "k4")
    if any(camera.distortion[len(terms) :]):
        # nerfstudio's k4 is the fourth coefficient of a polynomial, not OpenCV's k4.
        raise InputError(
            "there are no terms for k4 k5 k6 of this camera; calibrate it with k1 k2 p1 p2 k3,"
            " or undistort the images"
        )
    frames = []
    matrices = pose_numbers(poses, "matrix:opengl").reshape(-1, 4, 4).tolist()
    for name, matrix in zip(names, matrices, strict=True):
        frames.append({"file_path": name, "transform_matrix": matrix})
    record = {
        "camera_model": model,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        **dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0),
        **dict(zip(terms, camera.coefficients, strict=False)),
        "frames": frames,
    }
    return json.dumps(record, indent=1, allow_nan=False) + "\n"


def moveit(export: Export) -> str:
    """Write the pose pairs that MoveIt Calibration solves: 4x4 matrices by row, metres."""
    robot = export.robot_poses
    target = export.target_poses
    if robot is None or target is None:
        raise InputError(
            "a calibration holds no pose pairs; give the gripper's poses with `robot_poses`"
            " and the board's poses in the camera with `target_poses`"
        )
    targets = target.poses
    if robot.names and target.names and robot.names != target.names:
        single = sorted({*robot.names} ^ {*target.names})
        if single:
            raise InputError(f"{single[0]!r} has only one of its two poses")
        targets = targets[[target.names.index(name) for name in robot.names]]
    if len(robot) != len(target):
        raise InputError(
            f"{len(robot)} robot poses and {len(target)} target poses; give one of each for every"
            " image"
        )
    effectors = pose_numbers(robot.poses, "matrix").tolist()
    objects = pose_numbers(targets, "matrix").tolist()
    keys = ("effector_wrt_world", "object_wrt_sensor")
    pairs = zip(effectors, objects, strict=True)
    samples = [dict(zip(keys, pair, strict=True)) for pair in pairs]
    return _yaml(samples, None, 1000)
