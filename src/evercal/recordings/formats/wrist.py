"""A plain folder: images, and the gripper pose or joint angles at each, see docs/formats.md.

Images with a pose become training frames with base_from_gripper; gripper_from_camera is unknown.
All images come from one camera.
"""

import os
from pathlib import Path, PurePath

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import IMAGE_ENDINGS, image_size
from evercal.recordings.poses.camera_file import read_camera_of_size
from evercal.recordings.poses.kinematics import RobotModel, read_joint_poses
from evercal.recordings.poses.pairing import pair_images
from evercal.recordings.poses.robot_poses import POSE_ENDINGS, RobotPoses, read_robot_poses
from evercal.recordings.poses.row_files import natural_key, read_rows
from evercal.recordings.read_options import ReadOptions, flag
from evercal.recordings.text_files import named_errors, refuse_repeated

USES = ("camera", "base_frame", "gripper_frame", "urdf", "pose_convention")
_POSES = tuple(f"base_from_gripper{ending}" for ending in POSE_ENDINGS)
_JOINTS = ("joints.csv", "joints.json")
_CAMERAS = tuple(
    f"{stem}.{ending}"
    for stem in ("camera", "camera_info")
    for ending in ("json", "yaml", "yml", "xml", "npz", "txt")
)
_FOLDERS = (".", "images", "rgb")


def detect(root: Path) -> bool:
    """Whether `root` holds gripper poses or joint angles beside images."""
    return any((root / name).is_file() for name in _POSES + _JOINTS)


def load(root: Path, options: ReadOptions | None = None) -> Recording:
    """Read poses, intrinsics and the size of one image; no other image is opened."""
    options = options or ReadOptions()
    file = _pose_file(root)
    rows, notes = _rows(root, file, options)
    images = _images(root)
    camera = _camera(root, options.camera, images[0])
    poses, pairing_notes = pair_images(images, rows, _stamps(root), file)
    frames = tuple(
        Frame(image.name, image, camera, None, pose)
        for image, pose in zip(images, poses, strict=True)
        if pose is not None
    )
    lost = len(images) - len(frames)
    return Recording(root.resolve().name, frames, (), lost, notes=(*notes, *pairing_notes))


def _pose_file(root: Path) -> Path:
    names = [name for name in _POSES + _JOINTS if (root / name).is_file()]
    if len(names) > 1:
        raise InputError(f"{root}: holds {' and '.join(names)}; keep the one with gripper poses")
    if not names:
        raise InputError(f"{root}: no gripper poses; expected {', '.join(_POSES + _JOINTS)}")
    return root / names[0]


def _rows(root: Path, file: Path, options: ReadOptions) -> tuple[RobotPoses, list[str]]:
    if file.name in _JOINTS:
        model = RobotModel(options.urdf or _urdf(root, file))
        links = options.base_frame, options.gripper_frame
        return read_joint_poses(file, model, *links, options.pose_convention)
    unused = [n for n in ("urdf", "base_frame", "gripper_frame") if getattr(options, n) is not None]
    if unused:
        raise InputError(
            f"{flag(unused[0])}: {file} holds gripper poses already; leave the option out, or give"
            f" joint angles in joints.csv instead"
        )
    return read_robot_poses(file, options.pose_convention, option="--pose-convention"), []


def _urdf(root: Path, joints: Path) -> Path:
    files = sorted(root.glob("*.urdf"))
    if len(files) != 1:
        number = f"{len(files)} URDF files" if files else "no URDF"
        raise InputError(f"{root}: {joints.name} needs a URDF, {number} is beside it; give --urdf")
    return files[0]


def _images(root: Path) -> list[Path]:
    for folder in _FOLDERS:
        names = os.listdir(root / folder) if (root / folder).is_dir() else []
        images = [name for name in names if Path(name).suffix.lower() in IMAGE_ENDINGS]
        if images:
            return [root / folder / name for name in sorted(images, key=natural_key)]
    raise InputError(f"{root}: no images ({', '.join(IMAGE_ENDINGS)}) in it, in images or in rgb")


def _camera(root: Path, file: Path | None, image: Path) -> Camera:
    if file is None:
        names = [name for name in _CAMERAS if (root / name).is_file()]
        if len(names) != 1:
            files = f"{' and '.join(names)} in it" if names else "no camera file in it"
            raise InputError(
                f"{root}: {files}; name the file of the intrinsics with --camera (3x3 matrix, JSON,"
                f" YAML, NPZ or OpenCV's storage), or put it there as camera.json, .yaml, .xml,"
                f" .npz or .txt"
            )
        file = root / names[0]
    return read_camera_of_size(file, image_size(image), image.name)


def _stamps(root: Path) -> dict[str, float] | None:
    file = root / "stamps.csv"
    if not file.is_file():
        return None
    rows = read_rows(file, "a time for each image")
    if rows.names is None or rows.stamps_s is None:
        raise InputError(f"{file}: needs the columns image and stamp_s")
    names = [PurePath(name).name for name in rows.names]
    with named_errors(file, "stamps"):
        refuse_repeated(names, "give every image one time")
    return dict(zip(names, rows.stamps_s.tolist(), strict=True))
