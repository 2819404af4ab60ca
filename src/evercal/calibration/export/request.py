"""`Export`: the input of every format writer, prepared from a calibration and `ExportOptions`.

tf is a tree: a camera driver publishes `camera_link` as the parent of its optical frames, which can
have no second parent. By ROS REP 103, a link has x forward, y left, z up, and an optical frame has
x right, y down, z forward. The offset between their origins is in `/tf_static` or the data sheet.
"""

import re
from collections.abc import Mapping
from dataclasses import field, replace
from pathlib import Path
from typing import Any, TypeAlias, TypedDict, Unpack

import numpy as np

from evercal.calibration.framed_pose import FramedPose
from evercal.choices import Motors
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.poses.conventions import numbers_from_poses, pose_convention
from evercal.recordings.poses.robot_poses import RobotPoses, read_robot_poses
from evercal.robot.frame_names import FrameNames
from evercal.robot.mount import mount_named
from evercal.storage.text_files import read_text, yaml_documents
from evercal.typing import Array, PathLike, Triple

PoseSource: TypeAlias = RobotPoses | PathLike | None

# tf itself refuses only empty names and a leading slash; blanks, quotes and brackets would break
# the shell commands, launch files and XML that hold the names.
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*(/[A-Za-z0-9_.\-]+)*")


_UNKNOWN = {
    "base": "the name of the base frame is unknown: give `{}` (of Universal Robots, base for poses"
    " of the controller and base_link for those of tf, which are turned by 180 deg)",
    "gripper": "the name of the gripper frame is unknown: give `{}`, such as tool0 or flange",
    "camera": "the name of the camera's frame is unknown: give `{}`, such as"
    " camera_color_optical_frame",
}
"""What to do without the name of a frame."""


class ExportOptions(TypedDict, total=False):
    """Options of an export; all may be omitted."""

    lens: Camera | PathLike | None
    """Intrinsics that the programs use which take the pose: `stated` or `estimated`, see
    `FramedPose.lenses`, or a camera file. Default: the stated ones, where there are such."""
    parent: str | None
    """New name of the parent frame."""
    child: str | None
    """New name of the child frame."""
    via: str | None
    """Root frame of the camera driver, which becomes the child frame."""
    via_transform: PathLike | None
    """File with the transforms between the root frame and the optical frame."""
    via_offset: Triple | None
    """Origin of the optical frame in the root frame: forward, left, up, metres."""
    via_optical: bool
    """Whether the two frames share their origin."""
    robot_frame: str | None
    """New name of the robot's other frame: the gripper for eye_to_hand, else the base."""
    robot_poses: PoseSource
    """base_from_gripper of every image, or a file of them."""
    target_poses: PoseSource
    """camera_from_target of every image, or a file of them."""
    convention: str | None
    """Pose convention of the file of robot poses."""
    urdf: PathLike | None
    """URDF of the arm, for `corrected_urdf`."""
    lerobot_calibration: PathLike | None
    """Calibration file of a LeRobot arm, for `lerobot`."""
    lerobot_motors: Motors | None
    """Motors of that arm, which subtract the homing offset or add it."""


@frozen_arrays
class Export:
    """A calibration with what a format writer may need, see `ExportOptions`."""

    calibration: FramedPose
    """Calibration with the exported frames."""
    name: str
    """Name of the calibration in easy_handeye."""
    robot_poses: RobotPoses | None
    """base_from_gripper of every image."""
    target_poses: RobotPoses | None
    """camera_from_target of every image."""
    options: ExportOptions
    """All options, as given."""
    stated: list[float] = field(default_factory=list)
    """The last `numbers`."""
    notes: list[str] = field(default_factory=list)
    """What the other program cannot hold."""

    @property
    def parent(self) -> str:
        """Name of the parent frame."""
        return self.calibration.parent_frame

    @property
    def child(self) -> str:
        """Name of the child frame."""
        return self.calibration.child_frame

    @property
    def in_hand(self) -> bool:
        """Whether the gripper carries the camera."""
        return self.calibration.on_gripper

    @property
    def pose(self) -> SE3:
        """parent_from_child, metres."""
        return self.calibration.parent_from_child

    @property
    def camera(self) -> Camera:
        """Intrinsics; raises InputError if the calibration has no intrinsics."""
        if not self.calibration.camera:
            raise InputError(
                "intrinsics are required, but this calibration holds no camera"
            )
        return self.calibration.camera

    @property
    def comment(self) -> str:
        """Meaning of the numbers; the frame names in it are safe in any file."""
        lens = self.calibration.lens_in_words
        if lens:
            lens = f" For {lens}."
        return f"{self.calibration.meaning}.{lens} Written by evercal."

    def numbers(self, convention: str = "xyzw") -> list[float]:
        """The pose as numbers of a convention."""
        self.stated[:] = pose_numbers(self.pose, convention).tolist()
        return self.stated


def pose_numbers(poses: SE3, convention: str = "xyzw") -> Array:
    """Return (...) poses as numbers (..., k) of a convention, without negative zeros."""
    return numbers_from_poses(poses, pose_convention(convention)) + 0.0


def prepare_export(
    calibration: FramedPose, name: str = "evercal", **options: Unpack[ExportOptions]
) -> Export:
    """Turn the pose for the intrinsics, rename and move its frames, and read the files."""
    calibration = _for_lens(calibration, options.get("lens"))
    role_of = _frames_of_options(calibration).items()
    names = FrameNames(**{role: options.get(option) or "" for option, role in role_of})
    names = names.or_of(calibration.frames)
    link = options.get("via")
    link_from_optical = _link_from_optical(names.camera or "camera", options)
    if link is not None:
        moved = calibration.uncertain_pose @ link_from_optical.inverse()
        calibration = replace(
            calibration, parent_from_child=moved.pose, covariance=moved.covariance
        )
        names = replace(names, camera=link)
    for role, frame in vars(names).items():
        if frame and not _FRAME.fullmatch(frame):
            raise InputError(
                f"{role} frame {frame!r} is no name of a tf frame; use letters, digits, _ . - and"
                f" inner /, such as 'camera_color_optical_frame' (rename with `parent` or `child`)"
            )
    calibration = replace(calibration, frames=names)
    robot = options.get("robot_poses")
    target = options.get("target_poses")
    if robot is not None and not isinstance(robot, RobotPoses):
        what = "file of robot poses"
        convention = options.get("convention")
        robot = read_robot_poses(robot, convention, what=what, option="`convention`")
    if target is not None and not isinstance(target, RobotPoses):
        target = read_robot_poses(target, what="file of target poses", option=None)
    return Export(calibration, name, robot, target, options)


def _frames_of_options(calibration: FramedPose) -> dict[str, str]:
    mount = mount_named(calibration.mount)
    return {"parent": mount.parent, "child": "camera", "robot_frame": mount.scene}


def unknown_frames(calibration: FramedPose) -> dict[str, str]:
    """Frames without a name, by the option that names them: base, gripper or camera."""
    names = vars(calibration.frames)
    frames = _frames_of_options(calibration)
    return {option: role for option, role in frames.items() if not names[role]}


def require_names(calibration: FramedPose, both: bool) -> None:
    """Refuse unknown names of parent and child, and of the robot's other frame for `both`."""
    unknown = unknown_frames(calibration)
    if not both:
        unknown.pop("robot_frame", None)
    if unknown:
        raise InputError(
            "; ".join(_UNKNOWN[role].format(name) for name, role in unknown.items())
        )


def _for_lens(calibration: FramedPose, lens: Camera | PathLike | None) -> FramedPose:
    if lens is None:
        return calibration.for_program()
    if isinstance(lens, Camera):
        return calibration.for_lens(lens)
    if lens in ("stated", "estimated"):
        return calibration.for_lens(str(lens))
    own = calibration.camera
    return calibration.for_lens(read_camera(lens, own and own.size))


def _link_from_optical(optical: str, options: ExportOptions) -> SE3:
    link = options.get("via")
    file = options.get("via_transform")
    offset = options.get("via_offset")
    sources = [file is not None, offset is not None, options.get("via_optical", False)]
    if link is None and any(sources):
        raise InputError("name the driver's root frame with `via`, such as camera_link")
    if link is not None and sum(sources) != 1:
        raise InputError(
            f"`via` {link} needs the pose of the optical frame in it; give one of `via_transform`"
            f" FILE, `via_offset` X Y Z, or `via_optical` if their origins are the same"
        )
    if link is not None and file is not None:
        return read_link_from_optical(file, link, optical)
    return standard_link_from_optical(offset or (0.0, 0.0, 0.0))


_Transforms = dict[tuple[str, str], SE3]
_EXPECTED = (
    "give what 'ros2 topic echo --once /tf_static' prints, or a TransformStamped"
)


def standard_link_from_optical(
    offset_m: Triple = (0.0, 0.0, 0.0),
) -> SE3:
    """Return the pose of an optical frame whose origin lies forward, left, up in the link."""
    return SE3(np.array([0.5, -0.5, 0.5, -0.5]), np.array(offset_m))


def read_link_from_optical(path: PathLike, link: str, optical: str) -> SE3:
    """Read the pose of the optical frame in the driver's root frame from YAML or JSON.

    That is the output of `ros2 topic echo --once /tf_static`, a TransformStamped, or an object with
    `parent_frame`, `child_frame`, `translation_m`, `quaternion_wxyz`. Transforms are chained.
    """
    transforms: _Transforms = {}
    try:
        for document in yaml_documents(read_text(Path(path), "transforms")):
            transforms |= _transforms(document)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: no complete transform ({error}); {_EXPECTED}"
        ) from None
    if not transforms:
        raise InputError(f"{path}: contains no transform; {_EXPECTED}")
    transforms |= {
        (child, parent): pose.inverse() for (parent, child), pose in transforms.items()
    }
    link_from = {link: SE3.identity()}
    queue = [link]
    for frame in queue:
        for (parent, child), parent_from_child in transforms.items():
            if parent == frame and child not in link_from:
                link_from[child] = link_from[frame] @ parent_from_child
                queue.append(child)
    if optical not in link_from:
        frames = ", ".join(sorted({parent for parent, _ in transforms}))
        raise InputError(
            f"{path}: no transform leads from {link!r} to {optical!r}; its frames are {frames}."
            f" Name the optical frame with `child` and the driver's root frame with `via`"
        )
    return link_from[optical]


def _transforms(data: Any) -> _Transforms:
    if isinstance(data, list):
        transforms: _Transforms = {}
        for entry in data:
            transforms |= _transforms(entry)
        return transforms
    if not isinstance(data, Mapping):
        return {}
    if "transforms" in data:
        return _transforms(data["transforms"])
    if "transform" in data:
        transform = data["transform"]
        parent = data["header"]["frame_id"]
        child = data["child_frame_id"]
        translation = [float(transform["translation"][axis]) for axis in "xyz"]
        quaternion = [float(transform["rotation"][axis]) for axis in "wxyz"]
    elif "parent_frame" in data:
        parent = data["parent_frame"]
        child = data["child_frame"]
        translation = data["translation_m"]
        quaternion = data["quaternion_wxyz"]
    else:
        return {}
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > 1e-2:
        raise ValueError(f"quaternion {quaternion} is not of length 1")
    frames = (str(parent).lstrip("/"), str(child).lstrip("/"))
    return {frames: SE3(np.array(quaternion), np.array(translation))}
