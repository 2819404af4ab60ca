"""The table of export formats, and `export_calibration`."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias, Unpack

from evercal.calibration.calibration import Calibration
from evercal.calibration.export import image_poses, numbers, ros
from evercal.calibration.export.request import Export, ExportOptions, prepare_export
from evercal.errors import InputError
from evercal.storage import write_bytes

Content: TypeAlias = str | bytes | dict[str, str]
"""Text, bytes, or the texts of a folder by file name."""


@dataclass(frozen=True)
class Format:
    """One export format; every format takes fixed cameras and cameras on the arm."""

    frame: Literal["tf", "optical", "any"]
    """Child frame. `tf`: a frame of the robot's tf tree. `optical`: only the camera's optical
    frame, so `via` is refused. `any`: plain numbers of either frame."""
    write: Callable[[Export], Content]
    """Writer."""
    description: str
    """One line for `--format list`."""
    ending: str = ".txt"
    """Usual ending of the file; empty for a folder."""
    per_image: bool = False
    """Whether a camera on the arm needs the robot's pose of every image."""


FORMATS = {
    "easy_handeye2": Format(
        "tf", ros.easy_handeye2, "for ~/.ros2/easy_handeye2/calibrations", ".calib"
    ),
    "easy_handeye": Format(
        "tf", ros.easy_handeye, "easy_handeye of ROS 1, ~/.ros/easy_handeye", ".yaml"
    ),
    "moveit_samples": Format(
        "optical",
        image_poses.moveit_samples,
        "MoveIt Calibration's pose pairs (with --robot-poses and --target-poses)",
        ".yaml",
        per_image=True,
    ),
    "static_transform_publisher": Format(
        "tf", ros.publisher_command, "shell command that publishes the transform in ROS 2", ".sh"
    ),
    "launch_py": Format("tf", ros.launch_py, "ROS 2 launch file with a tf publisher", ".launch.py"),
    "ros1_launch": Format(
        "tf", ros.ros1_launch, "ROS 1 launch file, like MoveIt Calibration", ".launch"
    ),
    "transform_stamped": Format(
        "tf", ros.transform_stamped, "geometry_msgs/TransformStamped", ".yaml"
    ),
    "camera_info": Format("optical", ros.camera_info, "intrinsics for ROS", ".yaml"),
    "urdf": Format("tf", ros.urdf, "fixed joint for a URDF, rpy about fixed axes", ".urdf"),
    "opencv": Format(
        "optical", numbers.opencv, "rvec, tvec (parent to camera), FileStorage", ".yml"
    ),
    "csv": Format("any", numbers.csv, "4x4 matrix, metres, one matrix row per line", ".csv"),
    "npy": Format("any", numbers.npy, "4x4 matrix, metres, for numpy", ".npy"),
    "json": Format(
        "any", numbers.as_json, "matrix, quaternion w x y z, covariance, frames", ".json"
    ),
    "tum": Format(
        "optical", image_poses.tum, "stamp, translation, quaternion x y z w", ".tum", per_image=True
    ),
    "colmap": Format(
        "optical",
        image_poses.colmap,
        "cameras.txt, images.txt, points3D.txt (folder)",
        "",
        per_image=True,
    ),
    "nerfstudio": Format(
        "optical", image_poses.nerfstudio, "transforms.json, OpenGL axes", ".json", per_image=True
    ),
    "zivid": Format("any", numbers.zivid, "4x4 matrix in millimetres for Zivid's SDK"),
    "ur": Format("any", numbers.ur, "Universal Robots: p[x, y, z, rx, ry, rz]"),
    "kuka": Format("any", numbers.kuka, "KUKA: {X, Y, Z, A, B, C}, mm and degrees"),
    "abb": Format("any", numbers.abb, "ABB: [[x,y,z],[q1,q2,q3,q4]], mm"),
    "fanuc": Format("any", numbers.fanuc, "FANUC: X Y Z W P R, mm and degrees"),
    "yaskawa": Format("any", numbers.yaskawa, "Yaskawa: X Y Z Rx Ry Rz, mm and degrees"),
    "staubli": Format("any", numbers.staubli, "Staubli: X Y Z RX RY RZ, mm and degrees"),
    "franka": Format("any", numbers.franka, "Franka: 16 numbers by column, metres"),
}
"""All formats by name."""


@dataclass(frozen=True, eq=False)
class Exported:
    """A calibration in another format."""

    format: Format
    """Row of the table."""
    calibration: Calibration
    """Calibration with the exported frames."""
    text: str
    """Exported text; empty for a binary file or a folder."""
    files: tuple[Path, ...]
    """Files that were written; empty without a path."""


def export_calibration(
    calibration: Calibration,
    format: str,
    path: str | os.PathLike[str] | None = None,
    **options: Unpack[ExportOptions],
) -> str:
    """Export a calibration to the format of another program.

    Args:
        calibration: Calibration to export.
        format: Name of a format in `FORMATS`; hyphens count as underscores.
        path: File to write, or a new folder for COLMAP. If omitted, nothing is written.
        options: Frame names and further inputs, see `ExportOptions`.

    Returns:
        The exported text; empty for a binary file or a folder.

    Raises:
        InputError: The format is unknown, a required input is missing, or a frame name is invalid.
    """
    return export_files(calibration, format, path, **options).text


def export_files(
    calibration: Calibration,
    format: str,
    path: str | os.PathLike[str] | None = None,
    **options: Unpack[ExportOptions],
) -> Exported:
    """Export like `export_calibration`, and also return the written files."""
    key = format.strip().lower().replace("-", "_")
    if key not in FORMATS:
        raise InputError(f"export format {format!r} is not known; use one of {', '.join(FORMATS)}")
    row = FORMATS[key]
    # easy_handeye2 looks up ~/cell.calib under the name cell.
    name = "evercal" if path is None else Path(path).name.split(".")[0] or "evercal"
    export = prepare_export(calibration, name, **options)
    if row.frame == "optical" and options.get("via") is not None:
        raise InputError(f"{key} holds the pose of the camera, not of {export.child!r}; omit --via")
    try:
        content = row.write(export)
    except InputError as error:
        raise InputError(f"{key}: {error}") from None
    text = content if isinstance(content, str) else ""
    if path is None and not text:
        raise InputError(f"{key} is not text and cannot be printed; give --out")
    files = () if path is None else _write(Path(path), content)
    return Exported(row, export.calibration, text, files)


def _write(path: Path, content: Content) -> tuple[Path, ...]:
    """Write a file, or a folder that does not yet hold such files."""
    if isinstance(content, dict):
        files = {path / name: text for name, text in content.items()}
        existing = next((file for file in files if file.exists()), None)
        if existing is not None:
            raise InputError(f"{existing}: already there; give a new folder with --out")
        path.mkdir(parents=True, exist_ok=True)
    else:
        if not path.absolute().parent.is_dir():
            raise InputError(f"--out {path}: its folder does not exist; create it first")
        files = {path: content}
    for file, text in files.items():
        write_bytes(file, text if isinstance(text, bytes) else text.encode())
    return tuple(files)
