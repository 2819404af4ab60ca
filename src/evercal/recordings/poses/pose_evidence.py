"""Comparison of stated rotations with the images: inverted poses, other axes, mixed-up angles.

The rotation between two images of one scene follows from the images alone (the essential matrix;
Nister, An Efficient Solution to the Five-Point Relative Pose Problem, PAMI 2004). Correct camera
poses rotate equally. Correct gripper poses do so up to one fixed rotation between gripper and
camera. Inverted poses rotate about other axes.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3
from evercal.recordings.frame import Frame
from evercal.typing import Array, Float32Array

PAIRS = 16  # number of image pairs that are compared
LEAST_PAIRS = 6  # matched pairs below which there is no verdict
LEAST_DEG = 5.0
BEST_DEG = 12.0  # smallest and best stated rotation between the images of a pair
MOST_FRAMES_APART = 30  # largest distance between the images of a pair, frames
LEAST_MATCHES = (
    40  # feature matches, and inliers of them, below which a pair is dropped
)
LONG_SIDE = 640  # longer side of the images that are matched, pixels
AGREE_DEG = 2.0  # difference up to which rotations agree
STILL_DEG = 1.0  # median measured rotation below which the images stand still
BETTER = 3.0  # factor by which another reading must fit better to be named
CLOSE_DEG = 0.5  # margin within which further readings are named with the best
# Stricter for grippers: the free fixed rotation lets wrong readings fit better.
GRIPPER_AGREE_DEG = 1.0
GRIPPER_BETTER = 2.0
# OpenGL's camera axes (right, up, backward) from OpenCV's (right, down, forward).
_GL = Rotation.from_euler("x", 180, degrees=True)


def rotation_warnings(
    frames: Sequence[Frame], poses: SE3, of_camera: bool
) -> list[str]:
    """Describe contradictions between stated rotations and the images, in sentences.

    (n,) frames are in recorded order, (n,) poses base_from_camera or else base_from_gripper.
    """
    pairs, measured = measured_pairs(frames, poses)
    if len(measured) < LEAST_PAIRS:
        return []
    owner = "camera" if of_camera else "gripper"
    if (
        not of_camera
        and np.rad2deg(np.median(np.linalg.norm(measured, axis=1))) < STILL_DEG
    ):
        return [
            "the gripper rotates and the images hardly do; does the camera stand still, or are the"
            " angles in another unit than stated?"
        ]
    stated, readings = _readings(poses, pairs, of_camera)
    # Between gripper and camera is a fixed rotation that is not known.
    error_of, better = (
        (_error_deg, BETTER) if of_camera else (_fitted_error_deg, GRIPPER_BETTER)
    )
    error = error_of(measured, stated)
    errors = {
        reading: error_of(measured, vectors) for reading, vectors in readings.items()
    }
    improved = min(errors.values()) < error / better
    if error < (AGREE_DEG if of_camera or not improved else GRIPPER_AGREE_DEG):
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
        fitting = [reading for reading, e in errors.items() if e < least + CLOSE_DEG]
        return [
            f"{problem}; the poses fit ({least:.1f} deg) if they are {', or '.join(fitting)}"
        ]
    return [
        f"{problem}; do poses and images belong together, are angles in the stated unit and Euler"
        f" order, and are the intrinsics right?"
    ]


def _readings(
    poses: SE3, pairs: NDArray[np.intp], of_camera: bool
) -> tuple[Array, dict[str, Array]]:
    """(n, 3) rotation vectors first_from_second of pairs as stated, and in other readings."""
    first, second = pairs.T
    rotation = poses.rotation
    swapped = Rotation.from_quat(poses.rotation_wxyz)
    stated = (rotation[first].inv() * rotation[second]).as_rotvec()
    inverse = (rotation[first] * rotation[second].inv()).as_rotvec()
    readings = {
        f"{'camera' if of_camera else 'gripper'}_from_base, the inverse": inverse
    }
    if of_camera:
        readings["with OpenGL's camera axes (right, up, backward)"] = _GL.apply(stated)
        readings["the inverse with OpenGL's camera axes"] = _GL.apply(inverse)
    another_order = (swapped[first].inv() * swapped[second]).as_rotvec()
    return stated, readings | {"with quaternions in another order": another_order}


def measured_pairs(
    frames: Sequence[Frame], poses: SE3
) -> tuple[NDArray[np.intp], Array]:
    """(n, 2) frames of the pairs that match, and (n, 3) `measured_rotation` of each."""
    measured = [
        ((i, j), measured_rotation(frames[i], frames[j])) for i, j in _pairs(poses)
    ]
    pairs = [pair for pair, vector in measured if vector is not None]
    vectors = [vector for _, vector in measured if vector is not None]
    return np.array(pairs, np.intp).reshape(-1, 2), np.array(vectors)


def measured_rotation(first: Frame, second: Frame) -> Array | None:
    """(3,) rotation vector first_from_second in radians; None if there are too few matches."""
    features = [_features(frame) for frame in (first, second)]
    if min(len(rays) for rays, _ in features) < LEAST_MATCHES:
        return None
    neighbours = cv2.BFMatcher(cv2.NORM_L2).knnMatch(
        features[0][1], features[1][1], k=2
    )
    matches = [
        m[0] for m in neighbours if len(m) == 2 and m[0].distance < 0.75 * m[1].distance
    ]
    if len(matches) < LEAST_MATCHES:
        return None
    a = features[0][0][[m.queryIdx for m in matches]]
    b = features[1][0][[m.trainIdx for m in matches]]
    threshold = 1.5 / (
        first.camera.fx * min(1.0, LONG_SIDE / max(first.camera.width, 1))
    )
    cv2.setRNGSeed(0)
    matrix, inliers = cv2.findEssentialMat(
        a, b, np.eye(3), cv2.RANSAC, 0.999, threshold
    )
    if matrix is None or matrix.shape != (3, 3) or int(inliers.sum()) < LEAST_MATCHES:
        return None
    _, second_from_first, _, _ = cv2.recoverPose(matrix, a, b, np.eye(3), mask=inliers)
    return Rotation.from_matrix(second_from_first).inv().as_rotvec()


def _features(frame: Frame) -> tuple[Array, Float32Array]:
    """(n, 2) points of the plane z = 1, and their SIFT descriptors."""
    image = cv2.cvtColor(frame.read_image(), cv2.COLOR_RGB2GRAY)
    camera = frame.camera
    scale = LONG_SIDE / max(camera.width, camera.height)
    if scale < 1:
        camera = camera.resized(
            round(camera.width * scale), round(camera.height * scale)
        )
        image = cv2.resize(
            image, (camera.width, camera.height), interpolation=cv2.INTER_AREA
        )
    sift = cv2.SIFT_create(1500)  # pyright: ignore[reportAttributeAccessIssue]
    points, descriptors = sift.detectAndCompute(image, None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    rays = camera.unproject([point.pt for point in points])[:, :2]
    valid = np.isfinite(rays).all(1)
    return rays[valid], descriptors[valid]


def _pairs(poses: SE3) -> list[tuple[int, int]]:
    """Frames spread over the recording, each with a later one that is rotated enough.

    Large rotations separate the readings best, but with nonsensical angles only near frames are
    certain to match. Every second pair is therefore the nearest one.
    """
    rotation = poses.rotation
    pairs = []
    firsts = np.unique(np.linspace(0, len(poses) - 2, PAIRS).round().astype(int))
    for i, first in enumerate(firsts):
        later = np.arange(first + 1, min(first + 1 + MOST_FRAMES_APART, len(poses)))
        degrees = np.rad2deg((rotation[first].inv() * rotation[later]).magnitude())
        best = (
            np.argmin(np.abs(degrees - BEST_DEG))
            if i % 2
            else np.argmax(degrees > LEAST_DEG)
        )
        if degrees[best] > LEAST_DEG:
            pairs.append((int(first), int(later[best])))
    return pairs


def _error_deg(measured: Array, stated: Array) -> float:
    difference = Rotation.from_rotvec(measured).inv() * Rotation.from_rotvec(stated)
    return float(np.rad2deg(np.median(difference.magnitude())))


def _fitted_error_deg(measured: Array, stated: Array) -> float:
    """Median angle after the best fixed rotation between the two frames, degrees."""
    weights = np.ones(len(measured))
    rotation = Rotation.identity()
    for _ in range(5):  # iterative reweighting against outliers
        rotation = Rotation.align_vectors(measured, stated, weights)[0]
        distance = np.linalg.norm(rotation.apply(stated) - measured, axis=1)
        weights = 1 / (1 + (distance / max(float(np.median(distance)), 1e-6)) ** 2)
    return _error_deg(measured, rotation.apply(stated))
