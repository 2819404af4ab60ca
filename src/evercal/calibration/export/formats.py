"""The table of export formats, and `export_files`."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeAlias, Unpack

from evercal.calibration.export import joints as arm, simulators, writers as to
from evercal.calibration.export.read_back import require_read_back
from evercal.calibration.export.request import (
    Export,
    ExportOptions,
    prepare_export,
    require_names,
)
from evercal.calibration.framed_pose import FramedPose
from evercal.choices import ExportFormat
from evercal.classes import frozen, frozen_arrays
from evercal.errors import InputError
from evercal.storage import write_bytes
from evercal.typing import PathLike, Strings

Content: TypeAlias = str | bytes | dict[str, str]
"""Text, bytes, or the texts of a folder by file name."""
_SIMULATORS = ("mujoco", "isaac", "sapien", "pybullet", "blender")
_HOLD_INTRINSICS = ("camera_info", "opencv", "colmap", "nerfstudio", *_SIMULATORS)
"""Formats that hold the intrinsics which their pose is for."""


@frozen
class Exporter:
    """One export format; every format takes fixed cameras and cameras on the arm."""

    write: Callable[[Export], Content]
    """Writes the content of the file."""
    ending: str
    """Usual ending of the file; empty for a folder."""
    description: str
    """One line for `--format list`."""
    frame: Literal["tf", "optical", "any"] = "any"
    """Child frame. `tf`: a frame of the robot's tf tree. `optical`: only the camera's optical
    frame, so `via` is refused. `any`: plain numbers of either frame."""
    per_image: bool = False
    """Whether a camera on the arm needs the robot's pose of every image."""


FORMATS: dict[str, Exporter] = {
    "easy_handeye2": Exporter(
        to.easy_handeye2, ".calib", "for ~/.ros2/easy_handeye2", "tf"
    ),
    "easy_handeye": Exporter(
        to.easy_handeye, ".yaml", "for ~/.ros/easy_handeye of ROS 1", "tf"
    ),
    "moveit_samples": Exporter(
        to.moveit, ".yaml", "MoveIt Calibration's pairs", "optical", True
    ),
    "static_transform_publisher": Exporter(
        to.command, ".sh", "shell command for ROS 2", "tf"
    ),
    "launch_py": Exporter(
        to.launch_py, ".launch.py", "ROS 2 launch file with a tf publisher", "tf"
    ),
    "ros1_launch": Exporter(
        to.ros1_launch, ".launch", "ROS 1 launch file, like MoveIt's", "tf"
    ),
    "transform_stamped": Exporter(
        to.stamped, ".yaml", "geometry_msgs/TransformStamped", "tf"
    ),
    "camera_info": Exporter(to.camera_info, ".yaml", "intrinsics for ROS", "optical"),
    "urdf": Exporter(
        to.urdf, ".urdf", "fixed joint for a URDF, rpy about fixed axes", "tf"
    ),
    "opencv": Exporter(to.opencv, ".yml", "rvec and tvec, parent to camera", "optical"),
    "csv": Exporter(to.csv, ".csv", "4x4 matrix, metres, one matrix row per line"),
    "npy": Exporter(to.npy, ".npy", "4x4 matrix, metres, for numpy"),
    "json": Exporter(
        to.as_json, ".json", "matrix, quaternion wxyz, covariance, frames"
    ),
    "tum": Exporter(
        to.tum, ".tum", "stamp, translation, quaternion x y z w", "optical", True
    ),
    "colmap": Exporter(
        to.colmap, "", "a model without points (folder)", "optical", True
    ),
    "nerfstudio": Exporter(to.nerfstudio, ".json", "transforms.json", "optical", True),
    "mujoco": Exporter(simulators.mujoco, ".xml", "MuJoCo: an MJCF camera", "optical"),
    "isaac": Exporter(
        simulators.isaac, ".usda", "Isaac Sim and USD: a camera prim", "optical"
    ),
    "sapien": Exporter(
        simulators.sapien, ".py", "SAPIEN, ManiSkill: pose and camera", "optical"
    ),
    "pybullet": Exporter(
        simulators.pybullet, ".py", "PyBullet: view and projection matrix", "optical"
    ),
    "blender": Exporter(
        simulators.blender, ".py", "Blender: a script that adds the camera", "optical"
    ),
    "zivid": Exporter(to.zivid, ".txt", "4x4 matrix in millimetres for Zivid's SDK"),
    "ur": Exporter(to.ur, ".txt", "Universal Robots: p[x, y, z, rx, ry, rz]"),
    "kuka": Exporter(to.kuka, ".txt", "KUKA: {X, Y, Z, A, B, C}, mm and degrees"),
    "abb": Exporter(to.abb, ".txt", "ABB: [[x,y,z],[q1,q2,q3,q4]], mm"),
    "fanuc": Exporter(to.fanuc, ".txt", "FANUC: X Y Z W P R, mm and degrees"),
    "yaskawa": Exporter(to.yaskawa, ".txt", "Yaskawa: X Y Z Rx Ry Rz, mm and degrees"),
    "staubli": Exporter(to.staubli, ".txt", "Staubli: X Y Z RX RY RZ, mm and degrees"),
    "franka": Exporter(to.franka, ".txt", "Franka: 16 numbers by column, metres"),
    "joint_offsets": Exporter(
        arm.joint_offsets, ".json", "offsets of the arm's joints"
    ),
    "corrected_urdf": Exporter(
        arm.corrected_urdf, ".urdf", "`urdf` with these offsets"
    ),
    "lerobot": Exporter(
        arm.lerobot, ".json", "`lerobot_calibration` with these offsets"
    ),
}
"""All formats by name, an `ExportFormat`."""


@frozen_arrays
class Exported:
    """A calibration with the exported frames in another format."""

    format: Exporter
    calibration: FramedPose
    text: str
    """Exported text; empty for a binary file or a folder."""
    files: tuple[Path, ...]
    """Files that were written."""
    notes: Strings = ()
    """What the other program cannot hold."""


def export_files(
    calibration: FramedPose,
    format: ExportFormat | str,
    path: PathLike | None = None,
    **options: Unpack[ExportOptions],
) -> Exported:
    """Export a calibration to the format of another program.

    Args:
        calibration: Calibration to export.
        format: Name of a format in `FORMATS`; hyphens count as underscores.
        path: File to write, or a new folder for COLMAP. If omitted, nothing is written. Beside a
            pose for the estimated intrinsics these are written, too, as camera_info.
        options: Frame names and further inputs, see `ExportOptions`.
    """
    key = format.strip().lower().replace("-", "_")
    if key not in FORMATS:
        raise InputError(
            f"export format {format!r} is not known; use one of {', '.join(FORMATS)}"
        )
    exporter = FORMATS[key]
    # easy_handeye2 looks up ~/cell.calib under the name cell.
    name = "evercal"
    if path is not None:
        name = Path(path).name.split(".")[0] or name
    export = prepare_export(calibration, name, **options)
    if exporter.frame == "tf":
        require_names(export.calibration, key.startswith("easy_handeye"))
    if exporter.frame == "optical" and options.get("via") is not None:
        raise InputError(
            f"{key} holds the pose of the camera, not of {export.child!r}; omit `via`"
        )
    try:
        content = exporter.write(export)
        if export.stated:
            require_read_back(
                str(content), exporter.ending, export, exporter.frame == "tf"
            )
    except InputError as error:
        raise InputError(f"{key}: {error}") from None
    text = content if isinstance(content, str) else ""
    if path is not None:
        files = _write(Path(path), content)
        estimated = export.calibration.lens == "estimated"
        if estimated and key not in _HOLD_INTRINSICS:
            beside = Path(path).with_suffix(".camera_info.yaml")
            files += _write(beside, to.camera_info(export))
        return Exported(exporter, export.calibration, text, files, tuple(export.notes))
    if not text:
        raise InputError(f"{key} is not text and cannot be printed; give `out`")
    return Exported(exporter, export.calibration, text, (), tuple(export.notes))


def _write(path: Path, content: Content) -> tuple[Path, ...]:
    """Write a file, or a folder that does not yet hold such files."""
    if isinstance(content, dict):
        for name in content:
            file = path / name
            if file.exists():
                raise InputError(f"{file}: already there; give a new folder with `out`")
        path.mkdir(parents=True, exist_ok=True)
        for name, text in content.items():
            write_bytes(path / name, text.encode())
        return tuple(path / name for name in content)
    if not path.absolute().parent.is_dir():
        raise InputError(f"`out` {path}: its folder does not exist; create it first")
    if isinstance(content, str):
        content = content.encode()
    write_bytes(path, content)
    return (path,)
