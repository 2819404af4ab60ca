"""Pose estimates drawn into their images."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import resize_pixels
from evercal.reports.overlay import draw_residuals, resized

if TYPE_CHECKING:
    from evercal.geometry import SE3, Camera
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.learned import LearnedLocalizer

MAX_RESIDUAL_PX = 2.0
"""Upper end of the colour scale of residuals, pixels of the working image."""
PICTURE_PX = 640
"""Width of pictures in reports and videos."""


class LandmarkPicture(NamedTuple):
    """An image with its landmarks."""

    image: NDArray[np.uint8]
    """(h, w, 3) RGB."""
    landmarks: int
    """Number of landmarks."""
    summary: str
    """Their number and median residual; without landmarks, the reason."""


def draw_landmarks(
    image: NDArray[np.uint8],
    estimate: "PoseEstimate",
    localizer: "LearnedLocalizer",
    camera: "Camera | None" = None,
    base_from_camera: "SE3 | None" = None,
    width: int = PICTURE_PX,
) -> LandmarkPicture:
    """Resize an image and draw its landmarks, with lines from detections to projections.

    The camera is by default that of the estimate, else that of the scene; the pose that of the
    estimate. Residuals are in pixels of the image. Nothing is drawn without a pose or landmarks.
    """
    large, pose = resized(image, width), base_from_camera or estimate.base_from_camera
    pixels, points = estimate.pixels, estimate.points_m
    if pose is None or pixels is None or points is None or estimate.base_from_camera is None:
        return LandmarkPicture(large, 0, estimate.reason or estimate.status.replace("_", " "))
    scene = next(s for s in localizer.contents.scenes if s.name == estimate.scene)
    whole = camera or estimate.camera or scene.adjusted_camera
    working = whole.short_side_resized(localizer.contents.short_side)
    in_camera = scene.frame.camera_among_points(pose).inverse().apply(points)
    errors = working.project(in_camera) - pixels
    enlarged, own = large.shape[0] / working.height, image.shape[0] / working.height
    residuals = own * np.linalg.norm(errors, axis=1)
    drawn, times = draw_residuals(
        large, resize_pixels(pixels, enlarged), enlarged * errors, residuals, own * MAX_RESIDUAL_PX
    )
    median = float(np.nanmedian(residuals)) if np.isfinite(residuals).any() else np.nan
    count = len(residuals)
    words = f"{count} landmarks, median residual {median:.2f} px, lines {times} times as long"
    return LandmarkPicture(drawn, count, words)
