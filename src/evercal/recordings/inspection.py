"""Summary and plausibility checks of a recording."""

from collections import Counter
from collections.abc import Iterator, Sequence
from operator import attrgetter
from typing import Literal

import numpy as np

from evercal.classes import frozen
from evercal.geometry import SE3, Camera, norms, pose_distance
from evercal.geometry.near import near_training
from evercal.recordings.cameras.camera_fields import off_centre
from evercal.recordings.frame import (
    MIN_TRAIN_FRAMES,
    Frame,
    Recording,
    posed_frames,
)
from evercal.recordings.images import file_of
from evercal.recordings.pictures import look_at
from evercal.recordings.poses.pose_evidence import rotation_warnings
from evercal.recordings.stale_poses import stale_frames
from evercal.typing import Strings, Triple

SAME_M = 0.001
"""Distance below which two poses are the same, metres."""
SAME_DEG = 0.1
"""Angle below which two poses are the same, degrees."""
LARGEST_EXTENT_M = 100.0
"""Largest plausible side of the box around the positions, metres."""
LARGEST_STEP_M = 0.5
"""Largest plausible median distance between consecutive frames, metres."""
SMALLEST_EXTENT_M = 0.05
"""Smallest plausible side of the box around the positions, metres."""
LARGEST_REACH_M = 5.0
"""Largest plausible distance of a gripper from the base of its robot, metres."""
MOST_CAMERAS_LISTED = 4
"""Maximum number of intrinsics that are listed one by one; of more, each image size has a line."""


STILL = "evercal arm-in-view"
"""Words of a warning that the camera may stand still."""
Owner = Literal["camera", "gripper", "none"]
"""Owner of the poses of a recording."""


@frozen
class Inspection:
    """Summary of a recording."""

    name: str
    poses: Owner
    """Owner of the stated poses; the camera if both are stated."""
    train: int
    """Training frames with a pose."""
    test: int
    """Test frames with a pose."""
    untracked: int
    """Frames without a usable pose."""
    cameras: Strings
    """One line for each set of intrinsics."""
    metric: bool
    """Whether lengths are in metres; else their unit is unknown."""
    extent_m: Triple
    """Sides of the box around the training positions, metres."""
    step_median_m: float | None = None
    """Median distance between consecutive training frames, metres; None for fewer than two."""
    step_median_deg: float | None = None
    """Median rotation between consecutive training frames, degrees; None for fewer than two."""
    step_largest_m: float | None = None
    """Largest distance between consecutive training frames, metres; None for fewer than two."""
    near_training: float | None = None
    """Per cent of test frames with a training frame within 5 cm and 5 deg; None without frames, or
    where the unit is unknown."""
    notes: Strings = ()
    """Choices and omissions of the reader."""
    warnings: Strings = ()
    """What is implausible."""


def inspect_recording(recording: Recording) -> Inspection:
    """Check poses, cameras and some images of a recording."""
    frames = (*recording.train, *recording.test)
    owner: Owner = "none"
    if posed_frames(frames):
        owner = "camera"
    elif any(frame.base_from_gripper for frame in frames):
        owner = "gripper"
    pose_of = attrgetter(
        "base_from_gripper" if owner == "gripper" else "base_from_camera"
    )
    train = tuple(filter(pose_of, recording.train))
    test = tuple(filter(pose_of, recording.test))
    poses = SE3.stack([*map(pose_of, train)])
    test_poses = SE3.stack([*map(pose_of, test)])
    _require_image_sizes(frames)
    extent = np.ptp(poses.translation_m, axis=0) if train else np.zeros(3)
    largest = float(extent.max())
    untracked = recording.untracked + len(frames) - len(train) - len(test)
    shown = look_at(recording.train)
    cameras = Counter(frame.camera for frame in frames)
    warnings = [*_frame_warnings(len(train), len(test), untracked, owner)]
    warnings += shown.warnings
    for camera in cameras:
        warnings += _camera_warnings(camera)
    steps: dict[str, float] = {}
    if len(train) > 1:
        steps = _steps(poses)
        if recording.metric:
            step = steps["step_median_m"]
            warnings += _motion_warnings(poses, largest, step, owner)
        if _largest_turn_deg(poses) < SAME_DEG:
            warnings.append(
                "all training frames look the same way; are the rotations missing?"
            )
        if shown.usable:
            warnings += _contradictions(recording, train, poses, owner)
    near = None
    if train and test:
        same_m = SAME_M if recording.metric else SAME_M * largest
        if recording.metric:
            near = 100 * float(near_training(poses, test_poses).mean())
        warnings += _copy_warnings(train, test, poses, test_poses, same_m)
    x, y, z = extent.tolist()
    return Inspection(
        name=recording.name,
        poses=owner,
        train=len(train),
        test=len(test),
        untracked=untracked,
        cameras=tuple(_camera_lines(cameras)),
        metric=recording.metric,
        extent_m=(x, y, z),
        near_training=near,
        notes=recording.notes,
        warnings=tuple(warnings),
        **steps,
    )


def _contradictions(
    recording: Recording, train: Sequence[Frame], poses: SE3, owner: Owner
) -> list[str]:
    """Poses that the images contradict."""
    stale = ""
    if owner == "gripper":
        stale = stale_frames(train)
    if stale:
        return [stale]
    found = rotation_warnings(train, poses, owner == "camera", recording.convention)
    if recording.arm:  # of joints, 'evercal inspect' says more
        found = [warning for warning in found if STILL in warning]
    return found


def _require_image_sizes(frames: Sequence[Frame]) -> None:
    """Refuse images of another size than their camera's; one image of each size is read."""
    sizes = set()
    for frame in frames:
        size = frame.camera.size
        if size not in sizes:
            frame.read_image()
        sizes.add(size)


def _steps(poses: SE3) -> dict[str, float]:
    """Motion from each training frame to the next, as fields of `Inspection`."""
    metres, radians = pose_distance(poses[:-1], poses[1:])
    return {
        "step_median_m": float(np.median(metres)),
        "step_median_deg": float(np.rad2deg(np.median(radians))),
        "step_largest_m": float(metres.max()),
    }


def _largest_turn_deg(poses: SE3) -> float:
    """Largest rotation from the first pose to another one."""
    return float(np.rad2deg(pose_distance(poses[0], poses)[1].max()))


def _camera_lines(cameras: Counter[Camera]) -> Iterator[str]:
    if len(cameras) <= MOST_CAMERAS_LISTED:
        for camera, count in cameras.items():
            yield f"{_camera_line(camera)}; {count} frames"
        return
    sizes = [camera.size for camera in cameras]
    for size in dict.fromkeys(sizes):
        group = [camera for camera in cameras if camera.size == size]
        focal = [camera.fx for camera in group]
        count = sum(cameras[camera] for camera in group)
        yield (
            f"{size[0]}x{size[1]}, {len(group)} sets of intrinsics, fx {min(focal):.1f} to"
            f" {max(focal):.1f}; {count} frames"
        )


def _camera_line(camera: Camera) -> str:
    distortion = "no distortion"
    if camera.distortion:
        kind = "fisheye" if camera.model == "fisheye" else "distortion"
        numbers = " ".join(f"{k:g}" for k in camera.distortion)
        distortion = f"{kind} {numbers}"
    return (
        f"{camera.width}x{camera.height}, fx {camera.fx:.1f} fy {camera.fy:.1f}"
        f" cx {camera.cx:.1f} cy {camera.cy:.1f}, {distortion}"
    )


def _frame_warnings(
    train: int, test: int, untracked: int, owner: Owner
) -> Iterator[str]:
    if train < MIN_TRAIN_FRAMES:
        more = f"learning takes {MIN_TRAIN_FRAMES} or more"
        yield f"{train} training frames with a pose; {more}"
    if not test and owner != "gripper":
        yield "no test frame with a pose; 'evercal evaluate' has nothing to measure on"
    total = train + test + untracked
    if untracked > total / 2:
        yield f"{untracked} of {total} frames have no pose; check the tracking"


def _camera_warnings(camera: Camera) -> Iterator[str]:
    name = f"camera {camera.width}x{camera.height}"
    half_view = np.arctan(camera.width / (2 * camera.fx))
    view = np.rad2deg(2 * half_view)
    size = "are the intrinsics those of this image size?"
    if off_centre(camera) > 0.2:
        point = f"({camera.cx:.0f}, {camera.cy:.0f})"
        yield f"{name}: principal point {point} is far from the middle; {size}"
    if not 20 < view < 150:
        yield f"{name}: sees {view:.0f} deg across; {size}"
    ratio = camera.fx / camera.fy
    if not 0.9 < ratio < 1.1:
        focal = max(camera.fx, camera.fy)
        aspect = camera.width / camera.height
        yield (
            f"{name}: fx {camera.fx:.0f} and fy {camera.fy:.0f} are of images squeezed from"
            f" {aspect / ratio:.2f}:1 to {aspect:.2f}:1; if yours were cut out instead, both are"
            f" {focal:.0f}"
        )


def _motion_warnings(
    poses: SE3, extent: float, step: float, owner: Owner
) -> Iterator[str]:
    of_camera = owner == "camera"
    rotation_deg = _largest_turn_deg(poses)
    reach = float(np.median(norms(poses.translation_m)))
    if reach > LARGEST_REACH_M and not of_camera:
        yield (
            f"the gripper is {reach:.1f} m from the robot's base, farther than arms reach; are the"
            f" poses in millimetres?"
        )
    if extent < SAME_M:
        yield (
            f"all training frames stand at one point, rotating by {rotation_deg:.0f} deg; a map"
            f" takes views from several. Are the translations there, and in metres?"
        )
    elif extent < SMALLEST_EXTENT_M:
        yield (
            f"the training camera moves by {100 * extent:.1f} cm only; points may get no depth. Are"
            f" the translations in metres?"
        )
    if extent > LARGEST_EXTENT_M:
        yield f"the camera moves over {extent:.0f} m; are the poses in millimetres?"
    elif step > LARGEST_STEP_M and of_camera:
        yield f"consecutive frames are {step:.2f} m apart; are they in order and in metres?"


def _copy_warnings(
    train: Sequence[Frame],
    test: Sequence[Frame],
    poses: SE3,
    test_poses: SE3,
    same_m: float,
) -> Iterator[str]:
    from scipy.spatial import KDTree

    files = {file_of(f.image) for f in train} - {None}
    close = KDTree(poses.translation_m).query_ball_point(
        test_poses.translation_m, same_m
    )
    copies = 0
    for i, frame in enumerate(test):
        if file_of(frame.image) in files:
            copies += 1
        elif close[i]:
            radians = pose_distance(test_poses[i], poses[close[i]])[1]
            copies += bool(np.rad2deg(radians.min()) < SAME_DEG)
    if copies >= max(1, len(test) / 10):
        yield (
            f"{copies} of {len(test)} test frames have the pose or the file of a training frame;"
            f" accuracy on them means nothing"
        )
