"""Formats that hold a pose for every image: TUM, COLMAP, nerfstudio, MoveIt's pose pairs.

A fixed camera has one pose for all images, a camera on the arm one for every robot pose. COLMAP and
nerfstudio measure pixels from the corner of the first pixel, so their principal point is half a
pixel larger. Checked against pycolmap and nerfstudio's parser and `Cameras`.
"""

import json

import numpy as np
import yaml

from evercal.calibration.export.request import Export, pose_numbers
from evercal.errors import InputError
from evercal.geometry import SE3


def _image_poses(export: Export) -> tuple[tuple[str, ...], SE3]:
    robot = export.robot_poses
    if not export.in_hand:
        used = tuple(image.name for image in export.calibration.images if image.used)
        names = used or (f"{export.child.replace('/', '_')}.png",)
        return names, SE3.stack([export.pose] * len(names))
    if robot is None:
        raise InputError(
            "the pose of a camera on the arm changes with each image; give the gripper's poses with"
            " --robot-poses"
        )
    names = robot.names or tuple(f"{i:06d}.png" for i in range(len(robot)))
    return names, robot.poses @ export.pose


def tum(export: Export) -> str:
    """Write lines of stamp, translation in metres, quaternion x y z w: base_from_camera."""
    rows, robot = pose_numbers(_image_poses(export)[1]), export.robot_poses
    stamps = np.arange(len(rows), dtype=np.float64)
    if not export.in_hand:
        stamps, rows = stamps[:1], rows[:1]
    elif robot is not None and robot.stamps_s is not None:
        stamps = robot.stamps_s
    lines = [" ".join(map(repr, row)) for row in np.c_[stamps, rows].tolist()]
    return "\n".join(["# timestamp tx ty tz qx qy qz qw", *lines, ""])


def colmap(export: Export) -> dict[str, str]:
    """Write a sparse model without points: camera_from_base, quaternion w x y z."""
    camera, (names, poses) = export.camera, _image_poses(export)
    lines, rows = [], pose_numbers(poses, "wxyz:inverse").tolist()
    for i, (name, row) in enumerate(zip(names, rows, strict=True)):
        if len(name.split()) != 1:
            raise InputError(f"image name {name!r} contains a blank; rename the image")
        pose = " ".join(map(repr, [*row[3:], *row[:3]]))
        lines += [f"{i + 1} {pose} 1 {name}", ""]
    model, parameters = "PINHOLE", [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    if any(camera.distortion):
        four = len(camera.distortion) == 4
        model = "OPENCV" if four else "FULL_OPENCV"
        parameters += camera.distortion if four else camera.coefficients
    return {
        "cameras.txt": "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 {model} {camera.width} {camera.height} {' '.join(map(repr, parameters))}\n",
        "images.txt": "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        "# POINTS2D[] as (X, Y, POINT3D_ID)\n" + "\n".join([*lines, ""]),
        "points3D.txt": "# no points\n",
    }


def nerfstudio(export: Export) -> str:
    """Write transforms.json: base_from_camera with camera axes x right, y up, z back."""
    camera, (names, poses) = export.camera, _image_poses(export)
    matrices = pose_numbers(poses, "matrix:opengl").reshape(-1, 4, 4).tolist()
    k1, k2, p1, p2, k3, *rational = camera.coefficients
    if any(rational):
        # nerfstudio's k4 is the fourth coefficient of a polynomial, not OpenCV's k4.
        raise InputError(
            "there are no terms for k4 k5 k6 of this camera; calibrate it with k1 k2 p1 p2 k3,"
            " or undistort the images"
        )
    record = {
        "camera_model": "OPENCV",
        **{"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy},
        **{"cx": camera.cx + 0.5, "cy": camera.cy + 0.5},
        **{"k1": k1, "k2": k2, "k3": k3, "k4": 0.0, "p1": p1, "p2": p2},
        "frames": [
            {"file_path": name, "transform_matrix": matrix}
            for name, matrix in zip(names, matrices, strict=True)
        ],
    }
    return json.dumps(record, indent=1, allow_nan=False) + "\n"


def moveit(export: Export) -> str:
    """Write the pose pairs that MoveIt Calibration solves: 4x4 matrices by row, metres."""
    robot, target = export.robot_poses, export.target_poses
    if robot is None or target is None:
        raise InputError(
            "a calibration holds no pose pairs; give the gripper's poses with --robot-poses"
            " and the board's poses in the camera with --target-poses"
        )
    camera_from_target = target.poses
    if robot.names and target.names and robot.names != target.names:
        single = sorted({*robot.names} ^ {*target.names})
        if single:
            raise InputError(f"{single[0]!r} has only one of its two poses")
        camera_from_target = target.poses[[target.names.index(name) for name in robot.names]]
    if len(robot) != len(target):
        raise InputError(
            f"{len(robot)} robot poses and {len(target)} target poses; give one of each for every"
            " image"
        )
    rows = (pose_numbers(poses, "matrix").tolist() for poses in (robot.poses, camera_from_target))
    names = ("effector_wrt_world", "object_wrt_sensor")
    samples = [dict(zip(names, pair, strict=True)) for pair in zip(*rows, strict=True)]
    return yaml.safe_dump(samples, sort_keys=False, default_flow_style=None, width=1000)
