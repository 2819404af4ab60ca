"""Comparison of stated rotations with the images: inverted poses, other axes, mixed-up angles.

The rotation between two images of one scene follows from the images alone (the essential matrix;
Nister, An Efficient Solution to the Five-Point Relative Pose Problem, PAMI 2004). Correct camera
poses rotate equally. Correct gripper poses do so up to one fixed rotation between gripper and
camera. Inverted poses rotate about other axes.
"""

from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3, norms, spread
from evercal.geometry.motions import PairMotions
from evercal.recordings.frame import Frame
from evercal.recordings.poses.conventions import (
    OPENGL_FROM_OPENCV,
    UNITS,
    Given,
    numbers_from_poses,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.repeated_patches import reduced_grey
from evercal.typing import Array, Float32Array

PAIRS = 16
"""Image pairs that are compared."""
MIN_PAIRS = 6
"""Matched pairs below which there is no verdict."""
MIN_ROTATION_DEG = 5.0
"""Smallest stated rotation between the images of a pair, degrees."""
BEST_ROTATION_DEG = 12.0
"""Stated rotation of the other half of the pairs, as far as frames have it, degrees."""
MAX_FRAMES_APART = 30
"""Largest distance between the images of a pair, frames."""
MIN_MATCHES = 40
"""Feature matches, and inliers of them, below which a pair is dropped."""
RATIO = 0.75
"""Largest ratio of the distances of the nearest descriptors (Lowe's test)."""
EPIPOLAR_PX = 1.5
"""Distance of inliers from their epipolar lines, pixels of the reduced image."""
LONG_SIDE = 640
"""Longer side of the images that are matched, pixels."""
AGREE_DEG = 2.0
"""Median difference up to which stated and measured rotations agree, degrees."""
STILL_DEG = 1.0
"""Median measured rotation below which the images stand still, degrees."""
BETTER = 3.0
"""Factor by which the error of another reading must be smaller to be named."""
CLOSE_DEG = 0.5
"""Further readings are named within this of the smallest error, degrees."""
DIRECTIONS = 2.0
"""Readings that differ by this factor more in the directions of translations are not named."""
POSITION_PRIOR = 0.4
"""Weight of the position of a camera in the gripper, see `PairMotions.residuals`, 1/m^2."""
GRIPPER_AGREE_DEG = 1.0
"""`AGREE_DEG` of grippers: their free fixed rotation lets wrong readings fit better."""
GRIPPER_BETTER = 2.0
"""`BETTER` of grippers."""
_ORDERS = ("kuka", "yaskawa", "staubli", "kawasaki", "ur")
"""Conventions that differ in the order of angles."""


def rotation_warnings(
    frames: Sequence[Frame], poses: SE3, of_camera: bool, convention: str = ""
) -> list[str]:
    """Describe contradictions between stated rotations and the images, in sentences.

    (n,) frames are in recorded order, (n,) poses base_from_camera or else base_from_gripper, read
    from numbers in a convention.
    """
    motions = measured_motions(frames, poses)
    measured = motions.turns
    if len(measured) < MIN_PAIRS:
        return []
    owner = "camera"
    error_of = _error_deg
    better = BETTER
    if not of_camera:
        angles = norms(measured)
        if np.rad2deg(np.median(angles)) < STILL_DEG:
            return [
                "the gripper rotates and the images hardly do; does the camera stand still"
                " ('evercal arm-in-view' and 'evercal eye-to-hand' calibrate it), or are the angles"
                " in another unit than stated?"
            ]
        owner = "gripper"
        error_of = _fitted_error_deg  # a fixed rotation to the camera is not known
        better = GRIPPER_BETTER
    stated = _between(poses, motions).rotation.as_rotvec()
    given = pose_convention(convention) if convention else None
    readings = {}
    errors = {}
    for name, other in _readings(poses, of_camera, given):
        readings[name] = between = _between(other, motions)
        errors[name] = error_of(measured, between.rotation.as_rotvec())
    error = error_of(measured, stated)
    improved = min(errors.values()) < error / better
    agree = GRIPPER_AGREE_DEG if improved and not of_camera else AGREE_DEG
    if error < agree:
        return []
    if of_camera and not improved:
        fitted = _fitted_error_deg(measured, stated)
        errors["those of another frame, at a fixed angle to the camera"] = fitted
    problem = (
        f"the {owner} rotates differently from the images, by {error:.1f} deg in the median of"
        f" {len(measured)} pairs"
    )
    least = min(errors.values())
    if least < min(AGREE_DEG, error / better):
        fitting = [r for r in errors if errors[r] < least + CLOSE_DEG]
        if not of_camera:
            aside = [_aside(motions, readings[name]) for name in fitting]
            most = DIRECTIONS * min(aside)
            fitting = [r for r, off in zip(fitting, aside, strict=True) if off <= most]
        return [
            f"{problem}; the poses fit ({least:.1f} deg) if they are {', or '.join(fitting)}"
        ]
    return [
        f"{problem}; do poses and images belong together, are angles in the stated unit and Euler"
        f" order, and are the intrinsics right?"
    ]


def _readings(
    poses: SE3, of_camera: bool, convention: Given
) -> Iterator[tuple[str, SE3]]:
    """Poses in other readings, with their names."""
    yield from _other_orders(poses, convention)
    inverse = poses.inverse()
    owner = "camera" if of_camera else "gripper"
    yield f"{owner}_from_base, the inverse (append :inverse)", inverse
    if of_camera:
        turn = OPENGL_FROM_OPENCV
        name = "with OpenGL's camera axes"
        yield f"{name} (right, up, backward) (append :opengl)", poses @ turn
        yield f"the inverse {name} (append :inverse:opengl)", inverse @ turn


def _other_orders(poses: SE3, convention: Given) -> Iterator[tuple[str, SE3]]:
    """Poses with their angles or quaternions in another order, by its name."""
    if not convention or convention.is_matrix:
        return
    names = _ORDERS if convention.has_angles else ("wxyz", "xyzw")
    words = ["m" if convention.metres_per_unit == 1 else "mm"]
    if convention.has_angles:
        words.append("deg" if convention.degrees else "rad")
    words += [word for word in convention.name.split(":")[1:] if word not in UNITS]
    numbers = numbers_from_poses(poses, convention)
    for name in names:
        other = pose_convention(":".join([name, *words]))
        if other.layout != convention.layout:
            text = f"in another order, {other.name} ({other.meaning})"
            yield text, poses_from_numbers(numbers, other)


def _between(poses: SE3, motions: PairMotions) -> SE3:
    """(p,) first_from_second of the pairs."""
    first, second = motions.ends.T
    return poses[first].inverse() @ poses[second]


def _aside(motions: PairMotions, between: SE3) -> float:
    """Median difference of the directions of translations, after the best hand-eye transform."""
    _, aside = motions.residuals(between[None], POSITION_PRIOR)
    return float(np.median(norms(aside)))


def measured_motions(frames: Sequence[Frame], poses: SE3) -> PairMotions:
    """Motions of the camera between the pairs of frames that match.

    Frames spread over the recording, each with a later one that is rotated enough. Large rotations
    separate the readings best, but with nonsensical angles only near frames are certain to match.
    Every second pair is therefore the nearest one.
    """
    rotation = poses.rotation
    motions = {}
    for i, first in enumerate(spread(len(poses) - 1, PAIRS).tolist()):
        end = min(first + 1 + MAX_FRAMES_APART, len(poses))
        difference = rotation[first].inv() * rotation[first + 1 : end]
        degrees = np.rad2deg(difference.magnitude())
        best = np.argmax(degrees > MIN_ROTATION_DEG)
        if i % 2:
            best = np.argmin(np.abs(degrees - BEST_ROTATION_DEG))
        second = first + 1 + int(best)
        if degrees[best] > MIN_ROTATION_DEG:
            motion = measured_motion(frames[first], frames[second])
            motions[first, second] = motion
    return motions_of_pairs(motions)


def motions_of_pairs(motions: Mapping[tuple[int, int], SE3 | None]) -> PairMotions:
    """Motions first_from_second by pairs of image numbers; pairs without one are left out."""
    known = {pair: motion for pair, motion in motions.items() if motion}
    between = SE3.stack([SE3.identity(), *known.values()])[1:]
    turns = between.rotation.as_rotvec()
    ends = np.array([*known], np.int64).reshape(-1, 2)
    return PairMotions(ends, turns, between.translation_m)


def measured_motion(first: Frame, second: Frame) -> SE3 | None:
    """first_from_second with a translation of length 1; None if there are too few matches."""
    first_rays, first_descriptors = _features(first)
    second_rays, second_descriptors = _features(second)
    if min(len(first_rays), len(second_rays)) < MIN_MATCHES:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    rows = []
    for nearest, second_nearest in matcher.knnMatch(
        first_descriptors, second_descriptors, 2
    ):
        if nearest.distance < RATIO * second_nearest.distance:
            rows.append((nearest.queryIdx, nearest.trainIdx))
    if len(rows) < MIN_MATCHES:
        return None
    first_rows, second_rows = np.transpose(rows)
    a = first_rays[first_rows]
    b = second_rays[second_rows]
    scale = min(1.0, LONG_SIDE / max(first.camera.size))
    threshold = EPIPOLAR_PX / (first.camera.fx * scale)
    return motion_of_rays(a, b, threshold, MIN_MATCHES)


def motion_of_rays(a: Array, b: Array, epipolar: float, least: int = 0) -> SE3 | None:
    """first_from_second of rays (n, 2) at depth 1, with a translation of length 1.

    None if fewer than `least` are inliers, within `epipolar` of their epipolar lines.
    """
    cv2.setRNGSeed(0)
    matrix, inliers = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.999, epipolar)
    if np.shape(matrix) != (3, 3) or int(inliers.sum()) < least:
        return None
    _, matrix, shift, _ = cv2.recoverPose(matrix, a, b, np.eye(3), mask=inliers)
    second_from_first = SE3.of(Rotation.from_matrix(matrix), shift[:, 0])
    return second_from_first.inverse()


def _features(frame: Frame) -> tuple[Array, Float32Array]:
    """(n, 2) points of the plane z = 1, and their SIFT descriptors."""
    image = reduced_grey(frame.read_image(), LONG_SIDE)
    height, width = image.shape
    camera = frame.camera.resized(width, height)
    sift = cv2.SIFT_create(1500)  # pyright: ignore[reportAttributeAccessIssue]
    points, descriptors = sift.detectAndCompute(image, None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    pixels = [point.pt for point in points]
    rays = camera.unproject(pixels)[:, :2]
    valid = np.isfinite(rays).all(1)
    return rays[valid], descriptors[valid]


def _error_deg(measured: Array, stated: Array) -> float:
    """Median angle between (n, 3) rotation vectors, degrees."""
    difference = Rotation.from_rotvec(measured).inv() * Rotation.from_rotvec(stated)
    return float(np.rad2deg(np.median(difference.magnitude())))


def _fitted_error_deg(measured: Array, stated: Array) -> float:
    """Median angle after the best fixed rotation between the two frames, degrees."""
    weights = np.ones(len(measured))
    rotated = stated
    for _ in range(5):  # iterative reweighting against outliers
        rotation, *_ = Rotation.align_vectors(measured, stated, weights)
        rotated = rotation.apply(stated)
        distance = norms(rotated - measured)
        scale = max(float(np.median(distance)), 1e-6)
        weights = 1 / (1 + (distance / scale) ** 2)
    return _error_deg(measured, rotated)
