"""SIFT matches of two images that one essential matrix explains, and the camera motion.

SIFT's ratio test leaves repeated texture out, and the essential matrix tests the rest. Few matches
remain, but they are right where the encoder's cells mistake one square of a board for another.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.geometry import Camera
from evercal.typing import Array, Float32Array, Image, IntArray

FEATURES = 1500
"""Maximum number of SIFT features of an image."""
CONTRAST = 0.01
"""Minimum contrast of a feature."""
RATIO = 0.85
"""Maximum ratio of distances in Lowe's test."""
EPIPOLAR_PX = 1.0
"""Maximum distance of an inlier from its epipolar line, pixels."""
MIN_INLIERS = 20
"""Minimum number of inliers of a pair of images."""


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

    sift = cv2.SIFT.create(
        nfeatures=FEATURES,
        contrastThreshold=CONTRAST,
    )
    points, descriptors = sift.detectAndCompute(image, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
    if not points:
        return SiftFeatures(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    total = descriptors.sum(1, keepdims=True)
    shares = descriptors / np.maximum(total, 1e-9)
    pixels = np.array([point.pt for point in points])
    return SiftFeatures(pixels, np.sqrt(shares))


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
    pixels_a = a.pixels[rows]
    pixels_b = b.pixels[matched]
    # Undistorted here, so that PoseLib needs no camera model.
    ideal_a = first.unproject(pixels_a)[:, :2] * first.fx
    ideal_b = second.unproject(pixels_b)[:, :2] * second.fx
    moved_px = np.linalg.norm(pixels_a - pixels_b, axis=1)
    valid = np.isfinite(ideal_a + ideal_b).all(1)
    valid &= moved_px >= least_px
    if valid.sum() < MIN_INLIERS:
        return None
    ideal_a = ideal_a[valid]
    ideal_b = ideal_b[valid]
    pose, info = poselib.estimate_relative_pose(
        ideal_a,
        ideal_b,
        _ideal(first),
        _ideal(second),
        {"max_epipolar_error": EPIPOLAR_PX},
        {},
    )
    if info["num_inliers"] < MIN_INLIERS:
        return None
    length = float(np.linalg.norm(pose.t))
    direction = np.asarray(pose.t) / max(length, 1e-12)
    inliers = np.asarray(info["inliers"], bool)
    inliers = np.flatnonzero(inliers)
    plane_a = ideal_a[inliers] / first.fx
    plane_b = ideal_b[inliers] / second.fx
    rays = np.ones((2, len(inliers), 3))
    rays[0, :, :2] = plane_a
    rays[1, :, :2] = plane_b
    return EpipolarPair(
        rotation=Rotation.from_matrix(pose.R),
        direction=direction,
        rays=rays,
    )


def _distinct_matches(a: Float32Array, b: Float32Array) -> tuple[IntArray, IntArray]:
    similar = a @ b.T
    best = similar.argmax(1)
    best_of_b = similar.argmax(0)
    rows = np.arange(len(a))
    top = similar[rows, best].copy()
    mutual = best_of_b[best] == rows
    similar[rows, best] = -1
    second = similar.max(1)
    nearest = 2 - 2 * top
    nearest = np.maximum(nearest, 0)
    next_nearest = 2 - 2 * second
    next_nearest = np.maximum(next_nearest, 1e-9)
    distinct = nearest < RATIO**2 * next_nearest
    good = np.flatnonzero(mutual & distinct)
    return good, best[good]


def _ideal(camera: Camera) -> dict[str, object]:
    return {
        "model": "SIMPLE_PINHOLE",
        "width": 1,
        "height": 1,
        "params": [camera.fx, 0.0, 0.0],
    }
