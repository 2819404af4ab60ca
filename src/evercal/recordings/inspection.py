"""What a recorded scene looks like, and what looks wrong about it."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from evercal.geometry import SE3, Camera, near_training, pose_distance
from evercal.recordings.frame import MIN_TRAIN_FRAMES, Frame, Recording, posed_frames
from evercal.recordings.poses.pose_evidence import doubts

SAME_M, SAME_DEG = 0.001, 0.1
LARGEST_EXTENT_M = 100.0
LARGEST_STEP_M = 0.5
SMALLEST_EXTENT_M = 0.05
SMALLEST_TURN_DEG = 60.0
LARGEST_TURN_DEG = 30.0
LARGEST_REACH_M = 5.0
MOST_CAMERAS_TOLD = 4
LARGEST_PITCH_SHARE, LARGEST_ROLL_SHARE = 0.6, 0.8


@dataclass(frozen=True)
class Inspection:
    """What a recorded scene looks like."""

    name: str
    """Its own name."""
    poses: Literal["camera", "gripper", "none"]
    """Whose poses it states; those of the camera where it has both."""
    train: int
    """Training frames with a pose."""
    test: int
    """Test frames with a pose."""
    untracked: int
    """Frames without a usable pose."""
    cameras: tuple[str, ...]
    """One line for each set of intrinsics."""
    extent_m: tuple[float, float, float]
    """Sides of the box around the training positions, metres."""
    step_median_m: float | None
    """Median distance between consecutive training frames, metres; None for fewer than two."""
    step_median_deg: float | None
    """The same as an angle."""
    step_largest_m: float | None
    """Largest distance between consecutive training frames, metres."""
    near_training: float | None
    """Per cent of test frames with a training frame within 5 cm and 5 deg; None without any."""
    notes: tuple[str, ...]
    """What its reader chose, left out or could not know."""
    warnings: tuple[str, ...]
    """What looks wrong."""


def inspect_scene(scene: Recording) -> Inspection:
    """Looks at a scene's poses and cameras and at some of its images.

    Raises:
        InputError: An image that cannot be read or has not its camera's size.
    """
    both = (*scene.train, *scene.test)
    whose = "camera" if posed_frames(both) else "gripper" if any(map(_of_gripper, both)) else "none"
    pose_of = _of_gripper if whose == "gripper" else _of_camera
    train, test = (tuple(filter(pose_of, frames)) for frames in (scene.train, scene.test))
    cameras = Counter(frame.camera for frame in both)
    for size in {(camera.width, camera.height) for camera in cameras}:
        next(f for f in both if (f.camera.width, f.camera.height) == size).read_image()
    poses, tested = (SE3.stack([p for f in part if (p := pose_of(f))]) for part in (train, test))
    metres = radians = None
    if len(train) > 1:
        metres, radians = pose_distance(poses[:-1], poses[1:])
    extent = np.ptp(poses.translation_m, axis=0) if len(train) else np.zeros(3)
    near = 100 * float(near_training(poses, tested).mean()) if train and test else None
    lost = scene.untracked + len(both) - len(train) - len(test)
    warnings = [*_warn_frames(len(train), len(test), lost, whose), *_warn_cameras(cameras)]
    if len(train) > 1 and metres is not None:
        warnings += _warn_motion(poses, extent, float(np.median(metres)), whose == "camera")
        warnings += doubts(train, poses, whose == "camera")
    if train and test:
        warnings += _warn_copies(train, test, poses, tested)
    x, y, z = extent.tolist()
    return Inspection(
        scene.name,
        whose,
        len(train),
        len(test),
        lost,
        _described(cameras),
        (x, y, z),
        float(np.median(metres)) if metres is not None else None,
        float(np.rad2deg(np.median(radians))) if radians is not None else None,
        float(metres.max()) if metres is not None else None,
        near,
        scene.notes,
        tuple(warnings),
    )


def _of_camera(frame: Frame) -> SE3 | None:
    return frame.base_from_camera


def _of_gripper(frame: Frame) -> SE3 | None:
    return frame.base_from_gripper


def _described(cameras: Counter[Camera]) -> tuple[str, ...]:
    """One line a camera; one for all of a size where every frame has its own."""
    if len(cameras) <= MOST_CAMERAS_TOLD:
        return tuple(_describe(camera, count) for camera, count in cameras.items())
    lines = []
    for size in dict.fromkeys((camera.width, camera.height) for camera in cameras):
        group = {c: n for c, n in cameras.items() if (c.width, c.height) == size}
        focal = [camera.fx for camera in group]
        lines.append(
            f"{size[0]}x{size[1]}, {len(group)} sets of intrinsics, fx {min(focal):.1f} to"
            f" {max(focal):.1f}; {sum(group.values())} frames"
        )
    return tuple(lines)


def _describe(camera: Camera, count: int) -> str:
    lens = f"distortion {' '.join(f'{k:g}' for k in camera.distortion)}"
    return (
        f"{camera.width}x{camera.height}, fx {camera.fx:.1f} fy {camera.fy:.1f} cx {camera.cx:.1f}"
        f" cy {camera.cy:.1f}, {lens if any(camera.distortion) else 'no distortion'};"
        f" {count} frames"
    )


def _warn_frames(train: int, test: int, lost: int, whose: str) -> list[str]:
    found = []
    if train < MIN_TRAIN_FRAMES:
        found.append(
            f"{train} training frames with a pose; learning takes {MIN_TRAIN_FRAMES} or more"
        )
    if not test and whose != "gripper":
        found.append("no test frame with a pose; 'evercal evaluate' has nothing to measure on")
    if lost > (train + test + lost) / 2:
        found.append(f"{lost} of {train + test + lost} frames have no pose; check the tracking")
    return found


def _warn_cameras(cameras: Counter[Camera]) -> list[str]:
    found = []
    for camera in cameras:
        name = f"camera {camera.width}x{camera.height}"
        off = (
            abs((camera.cx + 0.5) / camera.width - 0.5),
            abs((camera.cy + 0.5) / camera.height - 0.5),
        )
        view = np.rad2deg(2 * np.arctan(camera.width / (2 * camera.fx)))
        if max(off) > 0.2:
            found.append(
                f"{name}: principal point ({camera.cx:.0f}, {camera.cy:.0f}) is far from the"
                f" middle; are the intrinsics those of this image size?"
            )
        if not 20 < view < 150:
            found.append(
                f"{name}: sees {view:.0f} deg across; are the intrinsics those of this image size?"
            )
        if not 0.8 < camera.fx / camera.fy < 1.25:
            found.append(
                f"{name}: fx {camera.fx:.0f} and fy {camera.fy:.0f} differ; square pixels?"
            )
    return found


def _warn_motion(poses: SE3, extent: np.ndarray, step: float, of_camera: bool) -> list[str]:
    found = []
    _, turned = pose_distance(poses[0], poses)
    if not of_camera:
        found += _warn_reach(poses)
    if extent.max() < SAME_M:
        found.append(
            f"all training frames stand at one point, turning by {np.rad2deg(turned.max()):.0f}"
            f" deg; a map takes views from several. Are the translations there, and in metres?"
        )
    elif extent.max() < SMALLEST_EXTENT_M:
        found.append(
            f"the training camera moves by {100 * extent.max():.1f} cm only; points may get no"
            f" depth. Are the translations in metres?"
        )
    if np.rad2deg(turned.max()) < SAME_DEG:
        found.append("all training frames look the same way; are the rotations missing?")
    if extent.max() > LARGEST_EXTENT_M:
        found.append(f"the camera moves over {extent.max():.0f} m; are the poses in millimetres?")
    elif step > LARGEST_STEP_M and of_camera:
        found.append(
            f"consecutive frames are {step:.2f} m apart; are they in recorded order and in metres?"
        )
    about_x, _, about_z = turning_shares(poses)
    if of_camera and np.rad2deg(turned.max()) > SMALLEST_TURN_DEG:
        if about_x > LARGEST_PITCH_SHARE:
            found.append(
                f"{100 * about_x:.0f} % of the turning is a nod about the image's x axis; are"
                f" quaternions in the order w x y z, and camera axes right, down, forward?"
            )
        if about_z > LARGEST_ROLL_SHARE:
            found.append(
                f"{100 * about_z:.0f} % of the turning is a roll about the viewing axis; are poses"
                f" base_from_camera, not their inverse, and camera axes right, down, forward?"
            )
    return found


def _warn_reach(poses: SE3) -> list[str]:
    """Gripper poses that no arm has."""
    reach = float(np.median(np.linalg.norm(poses.translation_m, axis=1)))
    if reach > LARGEST_REACH_M:
        return [
            f"the gripper is {reach:.1f} m from the robot's base, farther than arms reach; are the"
            f" poses in millimetres?"
        ]
    return []


def turning_shares(poses: SE3) -> tuple[float, float, float]:
    """About which camera axes (x, y, z) the camera turns from frame to frame; the three sum to 1.

    A camera that is carried about turns mostly about its y axis, as it pans. Inverted poses seem to
    roll, and quaternions in another order or a body's axes (x forward) seem to nod. Leaps between
    recordings are passed over. Thirds where nothing turns.
    """
    turns = (poses[:-1].inverse() @ poses[1:]).log()[:, 3:]
    turns = turns[np.linalg.norm(turns, axis=1) < np.deg2rad(LARGEST_TURN_DEG)]
    squares = np.square(turns).sum(axis=0)
    if squares.sum() < 1e-12:
        return 1 / 3, 1 / 3, 1 / 3
    x, y, z = (squares / squares.sum()).tolist()
    return x, y, z


def _warn_copies(
    train: Sequence[Frame], test: Sequence[Frame], poses: SE3, tested: SE3
) -> list[str]:
    """Test frames that are training frames: the same file, or the very same pose."""
    from scipy.spatial import KDTree

    files = {f.image for f in train if isinstance(f.image, Path)}
    close = KDTree(poses.translation_m).query_ball_point(tested.translation_m, SAME_M)
    copies = 0
    for i, frame in enumerate(test):
        same = isinstance(frame.image, Path) and frame.image in files
        if not same and close[i]:
            same = bool(np.rad2deg(pose_distance(tested[i], poses[close[i]])[1]).min() < SAME_DEG)
        copies += same
    if copies < max(1, len(test) / 10):
        return []
    return [
        f"{copies} of {len(test)} test frames have the pose or the file of a training frame;"
        f" accuracy on them says nothing"
    ]
