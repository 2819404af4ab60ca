"""Motion of the camera by the motion of landmarks from one image to the next."""

import cv2
import numpy as np

from evercal.geometry import SE3, Camera
from evercal.localization.hypothesis import Hypothesis
from evercal.localization.pose_refinement import Observed, minimise
from evercal.typing import Image

MOST_LANDMARKS = 60
"""Maximum number of landmarks that are followed."""
LEAST_LANDMARKS = 12
"""Minimum number of landmarks that are followed."""
_WINDOW_PX = 15
"""Side of the square around a landmark that is followed."""
_HALVED = 3
"""Number of times the images are halved: landmarks may move by eight windows."""
_ITERATIONS = 6
"""Gauss-Newton iterations of the pose."""


def followed(
    before: Image,
    pose: Hypothesis,
    image: Image,
    camera: Camera,
    predicted: SE3,
) -> SE3 | None:
    """The pose map_from_camera of an image by optical flow; None if few landmarks are followed.

    The landmarks are the inliers of the pose of the image before, at the same size. They are
    searched around where the predicted pose shows them (Lucas and Kanade, pyramidal).
    """
    every = max(1, len(pose.pixels) // MOST_LANDMARKS)
    points = pose.points_m[::every]
    pixels = pose.pixels[::every].astype(np.float32)
    expected = camera.project(predicted.inverse().apply(points))
    ahead = np.isfinite(expected).all(1)
    if before.shape != image.shape or np.count_nonzero(ahead) < LEAST_LANDMARKS:
        return None
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before,
        image,
        pixels[ahead],
        expected[ahead].astype(np.float32),
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_HALVED,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    found = status.ravel() == 1
    count = np.count_nonzero(found)
    if count < LEAST_LANDMARKS:
        return None
    equal = np.tile(np.eye(2)[..., None], count)
    observed = Observed(moved[found].astype(float), points[ahead][found], equal)
    start = predicted.rotation_matrix(), predicted.translation_m
    minimum = minimise(observed, camera, start, _ITERATIONS)
    return minimum.pose(np.zeros((6, 6))).pose
