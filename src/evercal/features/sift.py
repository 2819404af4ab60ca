"""SIFT matches of two images that one essential matrix explains.

SIFT's ratio test leaves repeated texture out, and the essential matrix tests the rest. Few matches
remain, but they are right where the encoder's cells mistake one square of a board for another.
"""

import math

import numpy as np

from evercal.classes import frozen_arrays
from evercal.geometry import Camera, norms
from evercal.typing import Array, Float32Array, Image, IntArray

FEATURES = 1500
"""Maximum number of SIFT features of an image."""
CONTRAST = 0.01
"""Minimum contrast of a feature."""
RATIO = 0.85
"""Maximum ratio of distances in Lowe's test."""
EPIPOLAR_PX = 1.0
"""Maximum distance of an inlier from its epipolar line, pixels."""
ITERATIONS = 1000
"""Maximum number of samples for an essential matrix."""
MIN_INLIERS = 20
"""Minimum number of inliers of a pair of images."""


@frozen_arrays
class SiftFeatures:
    """Features of one image."""

    pixels: Array
    """(n, 2)."""
    descriptors: Float32Array
    """(n, 128) of unit length, RootSIFT (Arandjelovic and Zisserman, CVPR 2012)."""


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


def epipolar_rays(
    a: SiftFeatures,
    b: SiftFeatures,
    first: Camera,
    second: Camera,
    least_px: float = 0.0,
) -> Array | None:
    """Matches of two images that one essential matrix explains; None for fewer than `MIN_INLIERS`.

    They are rays (2, n, 3) at depth 1, in the frames of both cameras.
    Matches that move by less than `least_px` in the image do not count.
    """
    import cv2

    if min(len(a.pixels), len(b.pixels)) < MIN_INLIERS:
        return None
    rows, matched = _distinct_matches(a.descriptors, b.descriptors)
    pixels_a = a.pixels[rows]
    pixels_b = b.pixels[matched]
    rays_a = first.unproject(pixels_a)
    rays_b = second.unproject(pixels_b)
    rays = np.stack([rays_a, rays_b])
    moved_px = norms(pixels_a - pixels_b)
    valid = np.isfinite(rays).all((0, 2))
    valid &= moved_px >= least_px
    if valid.sum() < MIN_INLIERS:
        return None
    rays = rays[:, valid]
    # Rays of a pinhole with focal length 1.
    plane_a, plane_b = rays[:, :, :2]
    pinhole = np.eye(3)
    parameters = cv2.UsacParams()
    parameters.threshold = EPIPOLAR_PX / math.sqrt(first.fx * second.fx)
    parameters.maxIterations = ITERATIONS
    parameters.score = cv2.SCORE_METHOD_MSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    _, mask = cv2.findEssentialMat(
        plane_a,
        plane_b,
        pinhole,
        pinhole,
        None,
        None,
        params=parameters,
    )
    if mask is None:
        return None
    inliers = np.flatnonzero(mask)
    if len(inliers) < MIN_INLIERS:
        return None
    return rays[:, inliers]


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
