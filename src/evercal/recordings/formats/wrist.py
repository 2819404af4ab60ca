"""A plain folder: images, and where the gripper was when each was taken.

    ROOT/image-1.png, ...               or in ROOT/images, ROOT/rgb
    ROOT/base_from_gripper.csv          or .json, .npy, .tum, .txt: as `read_robot_poses` takes them
    ROOT/joints.csv, ROOT/arm.urdf      or joint angles and a URDF in its place
    ROOT/camera.json                    or .yaml, .yml, .xml, .txt: as `read_camera` takes it
    ROOT/stamps.csv                     optional: columns image, stamp_s

Rows go to images by name, by time or in order. Every image that gets a pose is a training frame
with base_from_gripper; where the camera is on the gripper is not known here. One camera took all.
"""

import os
from pathlib import Path, PurePath

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import IMAGE_ENDINGS, image_size
from evercal.recordings.poses.camera_file import read_camera
from evercal.recordings.poses.joint_states import read_joint_poses
from evercal.recordings.poses.kinematics import RobotModel
from evercal.recordings.poses.pairing import pair_images
from evercal.recordings.poses.robot_poses import RobotPoses, read_robot_poses
from evercal.recordings.poses.row_files import natural_key, read_rows
from evercal.recordings.read_options import ReadOptions, flag

USES = ("camera", "base_frame", "gripper_frame", "urdf", "pose_convention")
_POSES = tuple(f"base_from_gripper.{ending}" for ending in ("csv", "json", "npy", "tum", "txt"))
_JOINTS = ("joints.csv", "joints.json")
_CAMERAS = tuple(
    f"{stem}.{ending}"
    for stem in ("camera", "camera_info")
    for ending in ("json", "yaml", "yml", "xml", "txt")
)
_FOLDERS = (".", "images", "rgb")


def detect(root: Path) -> bool:
    """Whether `root` holds gripper poses or joint angles beside images."""
    return any((root / name).is_file() for name in _POSES + _JOINTS)


def load(root: str | os.PathLike[str], options: ReadOptions | None = None) -> Recording:
    """Reads poses and intrinsics, and the size of one image; no other image is opened.

    Raises:
        InputError: Poses, images or intrinsics are missing or broken, or do not go together.
    """
    root = Path(root)
    options = options or ReadOptions()
    file = _only(root, _POSES + _JOINTS, "gripper poses")
    rows, notes = _rows(root, file, options)
    images = _images(root)
    camera = _camera(root, options, images[0])
    stamps = _stamps(root)
    poses, paired = pair_images(images, rows, stamps, file)
    frames = tuple(
        Frame(image.name, image, camera, None, pose)
        for image, pose in zip(images, poses, strict=True)
        if pose is not None
    )
    lost = len(images) - len(frames)
    return Recording(root.resolve().name, frames, (), lost, notes=(*notes, *paired))


def _rows(root: Path, file: Path, options: ReadOptions) -> tuple[RobotPoses, list[str]]:
    if file.name in _JOINTS:
        model = RobotModel(options.urdf or _urdf(root, file))
        frames = options.base_frame, options.gripper_frame
        return read_joint_poses(file, model, *frames, options.pose_convention)
    for name in ("urdf", "base_frame", "gripper_frame"):
        if getattr(options, name) is not None:
            raise InputError(
                f"{flag(name)}: {file} holds gripper poses already; leave the option"
                f" out, or give joint angles in joints.csv instead"
            )
    return read_robot_poses(file, options.pose_convention), []


def _only(root: Path, names: tuple[str, ...], what: str) -> Path:
    found = [name for name in names if (root / name).is_file()]
    if len(found) > 1:
        raise InputError(f"{root}: holds {' and '.join(found)}; keep the one with the {what}")
    if not found:
        raise InputError(f"{root}: no {what}; expected {', '.join(names)}")
    return root / found[0]


def _urdf(root: Path, joints: Path) -> Path:
    found = sorted(root.glob("*.urdf"))
    if len(found) != 1:
        has = f"{len(found)} URDF files" if found else "no URDF"
        raise InputError(f"{root}: {joints.name} needs a URDF, and {has} is beside it; give --urdf")
    return found[0]


def _images(root: Path) -> list[Path]:
    for folder in _FOLDERS:
        place = root / folder
        names = os.listdir(place) if place.is_dir() else []
        images = [name for name in names if Path(name).suffix.lower() in IMAGE_ENDINGS]
        if images:
            return [place / name for name in sorted(images, key=natural_key)]
    raise InputError(f"{root}: no images ({', '.join(IMAGE_ENDINGS)}) in it, in images or in rgb")


def _camera(root: Path, options: ReadOptions, image: Path) -> Camera:
    size = image_size(image)
    file = options.camera
    if file is None:
        found = [name for name in _CAMERAS if (root / name).is_file()]
        if len(found) != 1:
            has = f"{' and '.join(found)} in it" if found else "no camera file in it"
            raise InputError(
                f"{root}: {has}; name the file of the intrinsics with --camera (3x3 matrix, JSON,"
                f" camera_info YAML or OpenCV's storage), or put it there as camera.json,"
                f" .yaml, .xml or .txt"
            )
        file = root / found[0]
    camera = read_camera(file, size)
    if (camera.width, camera.height) != size:
        raise InputError(
            f"{file}: is for images of {camera.width}x{camera.height}, {image.name} is"
            f" {size[0]}x{size[1]}; give the intrinsics of this image size"
        )
    return camera


def _stamps(root: Path) -> dict[str, float] | None:
    file = root / "stamps.csv"
    if not file.is_file():
        return None
    rows = read_rows(file, "a time for each image")
    if rows.names is None or rows.stamps_s is None:
        raise InputError(f"{file}: needs the columns image and stamp_s")
    names = [PurePath(name).name for name in rows.names]
    twice = [name for i, name in enumerate(names) if name in names[:i]]
    if twice:
        raise InputError(f"{file}: {twice[0]!r} comes twice; give every image one time")
    return dict(zip(names, rows.stamps_s.tolist(), strict=True))
