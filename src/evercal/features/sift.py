"""SIFT matches of two images that one essential matrix explains, and the camera motion.

SIFT's ratio test leaves repeated texture out, and the essential matrix tests the rest. Few matches
remain, but they are right where the encoder's cells mistake one square of a board for another.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import Camera
from evercal.typing import Array, Float32Array, Image

FEATURES, CONTRAST, RATIO = 1500, 0.01, 0.85
"""SIFT features of an image, their contrast, and the ratio of distances in Lowe's test."""
EPIPOLAR_PX, MIN_INLIERS = 1.0, 20
"""Distance of a match from its epipolar line, and matches of a pair of images."""


@dataclass(frozen=True, eq=False)
class SiftFeatures:
    """Features of one image."""

    pixels: Array
    """(n, 2)."""
    descriptors: Float32Array
    """(n, 128) of unit length, RootSIFT (Arandjelovic and Zisserman, CVPR 2012)."""


@dataclass(frozen=True, eq=False)
class EpipolarPair:
    """Motion of the camera between two images, and the matches that agree with it."""

    rotation: Rotation
    """second_camera_from_first_camera."""
    direction: Array
    """(3,) unit vector of its translation."""
    rays: Array
    """(2, n, 3) rays of the inliers in both camera frames, at depth 1."""


def sift_features(image: Image) -> SiftFeatures:
    """Detect and describe features of a grey image (h, w)."""
    import cv2

    sift = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=CONTRAST)
    points, descriptors = sift.detectAndCompute(image, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
    if not points:
        return SiftFeatures(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    shares = descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9)
    return SiftFeatures(np.array([point.pt for point in points]), np.sqrt(shares))


def epipolar_pair(
    a: SiftFeatures,
    b: SiftFeatures,
    first: Camera,
    second: Camera,
    least_px: float = 0.0,
) -> EpipolarPair | None:
    """Match two images and estimate the camera's motion; None for fewer than `MIN_INLIERS`.

    Matches that move by less than `least_px` in the image do not count.
    """
    import poselib

    if min(len(a.pixels), len(b.pixels)) < MIN_INLIERS:
        return None
    rows, matched = _distinct_matches(a.descriptors, b.descriptors)
    # Undistorted here, so that PoseLib needs no camera model.
    ideal_a = first.unproject(a.pixels[rows])[:, :2] * first.fx
    ideal_b = second.unproject(b.pixels[matched])[:, :2] * second.fx
    moved = np.linalg.norm(a.pixels[rows] - b.pixels[matched], axis=1)
    valid = np.isfinite(ideal_a + ideal_b).all(1) & (moved >= least_px)
    if valid.sum() < MIN_INLIERS:
        return None
    pose, info = poselib.estimate_relative_pose(
        ideal_a[valid],
        ideal_b[valid],
        _ideal(first),
        _ideal(second),
        {"max_epipolar_error": EPIPOLAR_PX},
        {},
    )
    if info["num_inliers"] < MIN_INLIERS:
        return None
    direction = np.asarray(pose.t) / max(float(np.linalg.norm(pose.t)), 1e-12)
    inliers = np.flatnonzero(np.asarray(info["inliers"], bool))
    plane = np.stack(
        [ideal_a[valid][inliers] / first.fx, ideal_b[valid][inliers] / second.fx]
    )
    rays = np.concatenate([plane, np.ones((2, len(inliers), 1))], 2)
    return EpipolarPair(Rotation.from_matrix(pose.R), direction, rays)


def _distinct_matches(
    a: Float32Array, b: Float32Array
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    similar = a @ b.T
    best = similar.argmax(1)
    rows = np.arange(len(a))
    top = similar[rows, best].copy()
    mutual = similar.argmax(0)[best] == rows
    similar[rows, best] = -1
    second = similar.max(1)
    distinct = np.maximum(2 - 2 * top, 0) < RATIO**2 * np.maximum(2 - 2 * second, 1e-9)
    good = np.flatnonzero(mutual & distinct)
    return good, best[good]


def _ideal(camera: Camera) -> dict[str, object]:
    return {
        "model": "SIMPLE_PINHOLE",
        "width": 1,
        "height": 1,
        "params": [camera.fx, 0.0, 0.0],
    }
