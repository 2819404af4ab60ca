"""Images and their poses in a table or in a file each, see docs/formats.md.

A plain folder states the gripper pose, the joint angles or the camera pose at each image. Folders
of other programs state camera poses. Of gripper poses, gripper_from_camera is unknown. All images
come from one camera, unless there is a camera file for each. EuRoC states the pose of the body, and
that of the camera on it in sensor.yaml. Record3D lists a rotation (quaternion xyzw) and a position,
with OpenGL's axes.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.cameras import camera_fields, camera_file
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import IMAGE_ENDINGS, files_in, first_size
from evercal.recordings.poses.conventions import pose_convention, poses_from_numbers
from evercal.recordings.poses.joint_tables import read_joint_poses
from evercal.recordings.poses.pairing import pair_images
from evercal.recordings.poses.robot_poses import (
    POSE_ENDINGS,
    RobotPoses,
    read_robot_poses,
)
from evercal.recordings.poses.row_files import number_array, read_rows, same_numbers
from evercal.recordings.read_options import ReadOptions
from evercal.robot.frame_names import FrameNames
from evercal.robot.robot_model import RobotModel
from evercal.storage.text_files import named_errors, read_json, refuse_repeated
from evercal.typing import JsonObject


class RecordingLayout(NamedTuple):
    """Paths in a recording of camera poses."""

    poses: str
    """Table, or folder with a file for each image."""
    images: str = ""
    """Folder of images; empty for `_FOLDERS`."""
    camera: str = ""
    """Camera file, or folder of one for each image; where it is missing, one of `_CAMERAS`."""
    convention: str | None = None
    """Convention of the poses, if they do not define it."""


LAYOUTS = (
    RecordingLayout("groundtruth.txt", "rgb", convention="tum:m"),  # TUM RGB-D
    # ScanNet's SensReader, and ACE with the same in test.
    RecordingLayout("pose", "color", "intrinsic/intrinsic_color.txt", "matrix:m"),
    RecordingLayout("train/poses", "train/rgb", "train/calibration", "matrix:m"),
    # Record3D.
    RecordingLayout("metadata", "rgb", "metadata"),
    RecordingLayout("metadata.json", "rgb", "metadata.json"),
    # EuRoC.
    RecordingLayout(
        "state_groundtruth_estimate0/data.csv", "cam0/data", "cam0/sensor.yaml"
    ),
    RecordingLayout(
        "mav0/state_groundtruth_estimate0/data.csv",
        "mav0/cam0/data",
        "mav0/cam0/sensor.yaml",
    ),
)
"""Recordings of other programs."""
_POSES = tuple(f"base_from_gripper{ending}" for ending in POSE_ENDINGS)
"""Files of gripper poses."""
NAMES = "frames.json"
"""File of the names of base, gripper and camera."""
_CAMERA_POSES = tuple(f"base_from_camera{ending}" for ending in POSE_ENDINGS)
"""Files of camera poses."""
ONE_POSE = "base_from_camera.txt"
"""File of camera poses, or of the one pose of a fixed camera."""
_JOINTS = ("joints.csv", "joints.json")
"""Files of joint angles."""
_CAMERAS = tuple(
    f"{stem}.{ending}"
    for stem in ("camera", "camera_info")
    for ending in ("json", "yaml", "yml", "xml", "npz", "txt")
)
"""Files of intrinsics."""
_FOLDERS = (".", "images", "rgb")
"""Folders of images."""
_RECORD3D = pose_convention("xyzw:opengl")
"""Convention of Record3D, after its numbers are rolled."""


def detect(root: Path) -> bool:
    """Whether `root` holds poses or joint angles beside images."""
    return root.is_dir() and bool(_layouts(root))


def load(root: Path, options: ReadOptions) -> Recording:
    """Read poses, intrinsics and sizes of images; no image is opened whole."""
    layouts = _layouts(root)
    if options.poses != "original":
        poses = Path(options.poses)
        if not (root / poses).exists():
            poses = poses.absolute()
        layouts = [RecordingLayout(str(poses))]
    if not layouts:
        expected = ", ".join(_POSES + _JOINTS + _CAMERA_POSES)
        raise InputError(f"{root}: no gripper poses; expected {expected}")
    if len(layouts) > 1:
        names = " and ".join(layout.poses for layout in layouts)
        raise InputError(
            f"{root}: holds {names}; keep the one with the poses of the images"
        )
    layout = layouts[0]
    train = _frames(root, layout, options)
    parts = [part and part.replace("train/", "test/") for part in layout]
    test_layout = RecordingLayout._make(parts)
    if test_layout == layout or not (root / test_layout.poses).exists():
        return train
    test = _frames(root, test_layout, options)
    notes = train.notes + test.notes
    untracked = train.untracked + test.untracked
    return replace(train, test=test.train, untracked=untracked, notes=notes)


def _layouts(root: Path) -> list[RecordingLayout]:
    tables = []
    for name in _POSES + _JOINTS + _CAMERA_POSES:
        file = root / name
        if not file.is_file():
            continue
        is_one_pose = name == ONE_POSE and len(file.read_bytes().split()) <= 16
        if not is_one_pose:
            tables.append(RecordingLayout(name))
    if tables:
        return tables
    layouts = []
    for layout in LAYOUTS:
        if (root / layout.poses).exists() and (root / layout.images).is_dir():
            layouts.append(layout)
    return layouts


def _frames(root: Path, layout: RecordingLayout, options: ReadOptions) -> Recording:
    """A recording of the frames with a pose, all for training."""
    images = _images(root, [layout.images] if layout.images else _FOLDERS)
    source = root / layout.poses
    file = root / layout.camera
    rows, notes = _rows(root, source, options, layout.convention)
    stamps = _stamps(root)
    poses, joints, more = pair_images(images, rows, stamps, source)
    if file.name == "sensor.yaml":
        with named_errors(file, "camera file"):
            stated = camera_file.fields_of(file).get("T_BS")
            numbers = camera_fields.numbers_of(stated, "T_BS", 16)
            body_from_camera = SE3.from_matrix(np.reshape(numbers, (4, 4)))
        poses = [pose and pose @ body_from_camera for pose in poses]
    intrinsics = options.camera
    if not intrinsics and layout.camera and file.exists():
        intrinsics = file
    cameras = _cameras(root, intrinsics, images)
    is_gripper = layout.poses in _POSES + _JOINTS
    owner = "base_from_gripper" if is_gripper else "base_from_camera"
    split = layout.images.rpartition("rgb")[0]
    frames = []
    for image, camera, pose, values in zip(images, cameras, poses, joints, strict=True):
        if pose and values is not None:
            angles = tuple(values.tolist()) or None
            own: JsonObject = {owner: pose, "joints_rad": angles}
            frames.append(Frame(split + image.name, image, camera, **own))
    lost = len(images) - len(frames)
    name = root.resolve().name
    notes = (*notes, *more)
    named = rows.frames
    if (root / NAMES).is_file():
        with named_errors(root / NAMES, "names of frames"):
            named = FrameNames.from_dict(read_json(root / NAMES, "names of frames"))
    if not is_gripper:
        named = FrameNames(named.base, "", named.gripper)
    return Recording(
        name,
        tuple(frames),
        (),
        lost,
        notes=notes,
        arm=rows.arm,
        frames=named,
        convention=rows.convention.name if rows.convention else "",
    )


def _rows(
    root: Path, file: Path, options: ReadOptions, convention: str | None
) -> tuple[RobotPoses, list[str]]:
    if file.name in _JOINTS:
        model = RobotModel(
            options.urdf or urdf_beside(root),
            options.whole_robot,
            options.unchecked_joints,
        )
        return read_joint_poses(file, model, options)
    if file.name.startswith("metadata"):
        numbers = read_json(file, "Record3D file").get("poses") or []
        with named_errors(file, "poses"):
            numbers = np.roll(number_array(numbers, "'poses'"), 3, axis=-1)
            names = tuple(map(str, range(len(numbers))))
            return RobotPoses(names, None, poses_from_numbers(numbers, _RECORD3D)), []
    if options.urdf:
        raise InputError(
            f"`urdf`: {file} holds poses already; leave the option out, or give joint angles in"
            " joints.csv instead"
        )
    convention = options.pose_convention or convention
    poses = read_robot_poses(
        file, convention, what="file of poses", option="`pose_convention`"
    )
    return poses, []


def urdf_beside(root: Path) -> Path:
    """The only URDF of a folder of joint angles."""
    files = files_in(root, (".urdf",))
    if len(files) != 1:
        number = f"{len(files)} URDF files" if files else "no URDF"
        raise InputError(
            f"{root}: a file of joints needs a URDF, {number} is beside it; give `urdf`"
        )
    return files[0]


def _images(root: Path, folders: Sequence[str]) -> list[Path]:
    for folder in folders:
        images = pictures_in(root / folder)
        if images:
            return images
    others = image_folders(root)
    if len(others) == 1:
        return pictures_in(others[0])
    where = " or in ".join("it" if folder == "." else folder for folder in folders)
    raise InputError(f"{root}: no images ({', '.join(IMAGE_ENDINGS)}) in {where}")


def pictures_in(folder: Path) -> list[Path]:
    """Images of a folder, without depth."""
    images = files_in(folder)
    return [image for image in images if "depth" not in image.name] or images


def image_folders(root: Path) -> list[Path]:
    """Folders with images in a folder, at any depth, without depth and masks."""
    files = files_in(root, glob="**/*")
    folders = sorted({file.parent for file in files})
    return [folder for folder in folders if folder.name not in ("depth", "masks")]


def _cameras(root: Path, file: Path | None, images: Sequence[Path]) -> list[Camera]:
    """Of each image, from a file for all or from a folder of one for each."""
    if not file:
        file = _camera_beside(root)
    if file.is_dir():
        return _cameras_in(file, images)
    camera = camera_file.read_camera_of_size(file, first_size(images), images[0].name)
    if file.name.startswith("metadata"):  # of Record3D
        with named_errors(file, "camera file"):
            fields = camera_file.fields_of(file)
            cameras = []
            for matrix in fields.get("perFrameIntrinsicCoeffs") or []:
                own = {**fields, "K": matrix}
                cameras.append(camera_file.camera_from_fields(own))
            if len(cameras) == len(images):
                return cameras
    return [camera] * len(images)


def _cameras_in(folder: Path, images: Sequence[Path]) -> list[Camera]:
    files = files_in(folder, (".txt",))
    if not same_numbers(
        [file.name for file in files], [image.name for image in images]
    ):
        raise InputError(
            f"{folder}: lacks the file of an image; give one for all with `camera`"
        )
    cameras = []
    for file, image in zip(files, images, strict=True):
        size = first_size([image, *images])
        cameras.append(camera_file.read_camera_of_size(file, size, image.name))
    return cameras


def _camera_beside(root: Path) -> Path:
    names = [name for name in _CAMERAS if (root / name).is_file()]
    if len(names) == 1:
        return root / names[0]
    files = f"{' and '.join(names)} in it" if names else "no camera file in it"
    raise InputError(
        f"{root}: {files}; name the file of the intrinsics with `camera` (3x3 matrix, JSON,"
        f" YAML, NPZ or OpenCV's storage), or put it there as camera.json, .yaml, .xml,"
        f" .npz or .txt"
    )


def _stamps(root: Path) -> dict[str, float] | None:
    file = root / "stamps.csv"
    if not file.is_file():
        return None
    rows = read_rows(file, "a time for each image")
    if rows.names is None or rows.stamps_s is None:
        raise InputError(f"{file}: needs the columns image and stamp_s")
    names = [PureWindowsPath(name).name for name in rows.names]
    with named_errors(file, "stamps"):
        refuse_repeated(names, "give every image one time")
    return dict(zip(names, rows.stamps_s.tolist(), strict=True))
