"""Summary and plausibility checks of a recording."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Literal

import numpy as np

from evercal.geometry import SE3, Camera, pose_distance
from evercal.geometry.near import near_training
from evercal.recordings.frame import (
    MIN_GRIPPER_FRAMES,
    MIN_TRAIN_FRAMES,
    Frame,
    Recording,
    posed_frames,
)
from evercal.recordings.images import file_of
from evercal.recordings.pictures import look_at
from evercal.recordings.poses.pose_evidence import rotation_warnings

SAME_M = 0.001
SAME_DEG = 0.1
LARGEST_EXTENT_M = 100.0
LARGEST_STEP_M = 0.5
SMALLEST_EXTENT_M = 0.05
LARGEST_REACH_M = 5.0
MOST_CAMERAS_LISTED = 4


@dataclass(frozen=True)
class Inspection:
    """Summary of a recording."""

    name: str
    poses: Literal["camera", "gripper", "none"]
    """Owner of the stated poses; the camera if both are stated."""
    train: int
    """Training frames with a pose."""
    test: int
    """Test frames with a pose."""
    untracked: int
    """Frames without a usable pose."""
    cameras: tuple[str, ...]
    """One line for each set of intrinsics."""
    metric: bool
    """Whether lengths are in metres; else their unit is unknown."""
    extent_m: tuple[float, float, float]
    """Sides of the box around the training positions, metres."""
    step_median_m: float | None
    """Median distance between consecutive training frames, metres; None for fewer than two."""
    step_median_deg: float | None
    """Median rotation between consecutive training frames, degrees; None for fewer than two."""
    step_largest_m: float | None
    """Largest distance between consecutive training frames, metres; None for fewer than two."""
    near_training: float | None
    """Per cent of test frames with a training frame within 5 cm and 5 deg; None without frames, or
    where the unit is unknown."""
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def inspect_recording(recording: Recording) -> Inspection:
    """Check poses, cameras and some images of a recording."""
    both = (*recording.train, *recording.test)
    grippers = any(frame.base_from_gripper for frame in both)
    owner = "camera" if posed_frames(both) else "gripper" if grippers else "none"
    pose_of = attrgetter(
        "base_from_gripper" if owner == "gripper" else "base_from_camera"
    )
    train, test = (
        tuple(filter(pose_of, part)) for part in (recording.train, recording.test)
    )
    cameras = Counter(frame.camera for frame in both)
    for size in {(camera.width, camera.height) for camera in cameras}:
        next(f for f in both if (f.camera.width, f.camera.height) == size).read_image()
    poses, tested = (SE3.stack([*map(pose_of, part)]) for part in (train, test))
    extent = np.ptp(poses.translation_m, axis=0) if len(train) else np.zeros(3)
    untracked = recording.untracked + len(both) - len(train) - len(test)
    shown = look_at(recording.train)
    warnings = [
        *_frame_warnings(len(train), len(test), untracked, owner),
        *shown.warnings,
    ]
    warnings += [warning for camera in cameras for warning in _camera_warnings(camera)]
    step_m = step_deg = largest_m = near = None
    if len(train) > 1:
        metres, radians = pose_distance(poses[:-1], poses[1:])
        step_m = float(np.median(metres))
        step_deg = float(np.rad2deg(np.median(radians)))
        largest_m = float(metres.max())
        of_camera = owner == "camera"
        if recording.metric:
            warnings += _motion_warnings(poses, float(extent.max()), step_m, of_camera)
        if np.rad2deg(pose_distance(poses[0], poses)[1].max()) < SAME_DEG:
            warnings.append(
                "all training frames look the same way; are the rotations missing?"
            )
        if shown.usable:
            warnings += rotation_warnings(train, poses, of_camera)
    if train and test:
        same_m = SAME_M if recording.metric else SAME_M * float(extent.max())
        warnings += _copy_warnings(train, test, poses, tested, same_m)
        near = (
            100 * float(near_training(poses, tested).mean())
            if recording.metric
            else None
        )
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
        step_median_m=step_m,
        step_median_deg=step_deg,
        step_largest_m=largest_m,
        near_training=near,
        notes=recording.notes,
        warnings=tuple(warnings),
    )


def _camera_lines(cameras: Counter[Camera]) -> Iterator[str]:
    if len(cameras) <= MOST_CAMERAS_LISTED:
        for c, count in cameras.items():
            kind = "fisheye" if c.model == "fisheye" else "distortion"
            distortion = f"{kind} {' '.join(f'{k:g}' for k in c.distortion)}"
            yield (
                f"{c.width}x{c.height}, fx {c.fx:.1f} fy {c.fy:.1f} cx {c.cx:.1f} cy {c.cy:.1f},"
                f" {distortion if c.distortion else 'no distortion'}; {count} frames"
            )
        return
    for size in dict.fromkeys((camera.width, camera.height) for camera in cameras):
        group = {c: n for c, n in cameras.items() if (c.width, c.height) == size}
        focal = [camera.fx for camera in group]
        yield (
            f"{size[0]}x{size[1]}, {len(group)} sets of intrinsics, fx {min(focal):.1f} to"
            f" {max(focal):.1f}; {sum(group.values())} frames"
        )


def _frame_warnings(train: int, test: int, untracked: int, owner: str) -> Iterator[str]:
    least = MIN_GRIPPER_FRAMES if owner == "gripper" else MIN_TRAIN_FRAMES
    if train < least:
        yield f"{train} training frames with a pose; learning takes {least} or more"
    if not test and owner != "gripper":
        yield "no test frame with a pose; 'evercal evaluate' has nothing to measure on"
    total = train + test + untracked
    if untracked > total / 2:
        yield f"{untracked} of {total} frames have no pose; check the tracking"


def _camera_warnings(camera: Camera) -> Iterator[str]:
    name = f"camera {camera.width}x{camera.height}"
    middle = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height
    view = np.rad2deg(2 * np.arctan(camera.width / (2 * camera.fx)))
    size = "are the intrinsics those of this image size?"
    if max(abs(share - 0.5) for share in middle) > 0.2:
        point = f"({camera.cx:.0f}, {camera.cy:.0f})"
        yield f"{name}: principal point {point} is far from the middle; {size}"
    if not 20 < view < 150:
        yield f"{name}: sees {view:.0f} deg across; {size}"
    if not 0.8 < camera.fx / camera.fy < 1.25:
        yield f"{name}: fx {camera.fx:.0f} and fy {camera.fy:.0f} differ; square pixels?"


def _motion_warnings(
    poses: SE3, extent: float, step: float, of_camera: bool
) -> Iterator[str]:
    rotation_deg = np.rad2deg(pose_distance(poses[0], poses)[1].max())
    reach = float(np.median(np.linalg.norm(poses.translation_m, axis=1)))
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
    tested: SE3,
    same_m: float,
) -> Iterator[str]:
    from scipy.spatial import KDTree

    files = {file_of(f.image) for f in train} - {None}
    close = KDTree(poses.translation_m).query_ball_point(tested.translation_m, same_m)
    copies = 0
    for i, frame in enumerate(test):
        copied = file_of(frame.image) in files
        if not copied and close[i]:
            radians = pose_distance(tested[i], poses[close[i]])[1]
            copied = bool(np.rad2deg(radians.min()) < SAME_DEG)
        copies += copied
    if copies >= max(1, len(test) / 10):
        yield (
            f"{copies} of {len(test)} test frames have the pose or the file of a training frame;"
            f" accuracy on them means nothing"
        )
