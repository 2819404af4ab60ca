"""All formats, by name."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from evercal.calibration.export import (
    camera_views,
    handeye_tools,
    plain,
    robots,
    ros,
    urdf,
)
from evercal.calibration.export.request import Content, Export
from evercal.errors import InputError
from evercal.storage import write_bytes


@dataclass(frozen=True)
class Format:
    """How a calibration becomes another program's file."""

    write: Callable[[Export], Content]
    """Its content."""
    ending: str
    """Of the file; empty for a folder."""
    description: str
    """One line for people."""


FORMATS: dict[str, Format] = {
    "easy_handeye2": Format(
        handeye_tools.easy_handeye2,
        ".calib",
        "easy_handeye2, for ~/.ros2/easy_handeye2/calibrations",
    ),
    "easy_handeye": Format(
        handeye_tools.easy_handeye, ".yaml", "easy_handeye of ROS 1, for ~/.ros/easy_handeye"
    ),
    "moveit_samples": Format(
        handeye_tools.moveit_samples,
        ".yaml",
        "MoveIt Calibration's pose pairs (with --robot-poses and --target-poses)",
    ),
    "static_transform_publisher": Format(
        ros.static_transform_publisher, ".sh", "shell line that publishes it in ROS 2"
    ),
    "launch_py": Format(ros.launch_py, ".launch.py", "ROS 2 launch file that publishes it"),
    "ros1_launch": Format(ros.ros1_launch, ".launch", "ROS 1 launch file, as MoveIt Calibration's"),
    "transform_stamped": Format(ros.transform_stamped, ".yaml", "geometry_msgs/TransformStamped"),
    "camera_info": Format(ros.camera_info, ".yaml", "the camera's intrinsics for ROS"),
    "urdf": Format(urdf.urdf, ".xml", "fixed joint for a URDF, rpy about fixed axes"),
    "opencv": Format(plain.opencv, ".yml", "rvec, tvec (parent to camera) by cv2.FileStorage"),
    "csv": Format(plain.csv, ".csv", "4x4 matrix, metres, a row a line"),
    "npy": Format(plain.npy, ".npy", "4x4 matrix, metres, for numpy"),
    "json": Format(plain.as_json, ".json", "matrix, quaternion w x y z, covariance, frame names"),
    "tum": Format(camera_views.tum, ".tum", "stamp, translation, quaternion x y z w"),
    "colmap": Format(camera_views.colmap, "", "folder with cameras.txt, images.txt, points3D.txt"),
    "nerfstudio": Format(camera_views.nerfstudio, ".json", "transforms.json, OpenGL camera axes"),
    "zivid": Format(robots.zivid, ".yaml", "4x4 matrix in millimetres, as Zivid's SDK loads it"),
    "ur": Format(robots.ur, ".txt", "Universal Robots: p[x, y, z, rx, ry, rz]"),
    "kuka": Format(robots.kuka, ".txt", "KUKA: {X, Y, Z, A, B, C}, mm and degrees"),
    "abb": Format(robots.abb, ".txt", "ABB: [[x,y,z],[q1,q2,q3,q4]], mm"),
    "fanuc": Format(robots.fanuc, ".txt", "FANUC: X Y Z W P R, mm and degrees"),
    "yaskawa": Format(robots.yaskawa, ".txt", "Yaskawa: X Y Z Rx Ry Rz, mm and degrees"),
    "staubli": Format(robots.staubli, ".txt", "Staubli: X Y Z RX RY RZ, mm and degrees"),
    "franka": Format(robots.franka, ".json", "Franka: 16 numbers column after column, metres"),
}

TF_FORMATS = (
    "easy_handeye2",
    "easy_handeye",
    "static_transform_publisher",
    "launch_py",
    "ros1_launch",
    "transform_stamped",
    "urdf",
)
"""Those that put the child frame into a robot's tf tree."""


def format_name(name: str) -> str:
    """The name as it stands in `FORMATS`; hyphens count as underscores.

    Raises:
        InputError: No such format.
    """
    found = name.strip().lower().replace("-", "_")
    if found not in FORMATS:
        raise InputError(f"export format {name!r} is not known; use one of {', '.join(FORMATS)}")
    return found


def write_content(path: str | os.PathLike[str], content: Content) -> list[Path]:
    """Writes what a format made; a file is replaced, a folder must not hold such files yet.

    Returns:
        The files.

    Raises:
        InputError: The folder holds one of the files already.
        OSError: As the system says.
    """
    path = Path(path)
    if isinstance(content, dict):
        files = {path / name: text for name, text in content.items()}
        there = next((file for file in files if file.exists()), None)
        if there is not None:
            raise InputError(f"{there}: already there; give a new folder with --out")
        path.mkdir(parents=True, exist_ok=True)
    else:
        files = {path: content}
    for file, text in files.items():
        write_bytes(file, text if isinstance(text, bytes) else text.encode())
    return list(files)
