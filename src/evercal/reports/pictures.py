"""Pose estimates drawn into their images."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import resize_pixels
from evercal.reports.overlay import overlay_points, overlay_vectors

MAX_RESIDUAL_PX = 2.0
"""Upper end of the colour scale of residuals, pixels of the working image."""

if TYPE_CHECKING:
    from evercal.geometry import SE3, Camera
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.learned import LearnedLocalizer, LearnedScene


def scene_camera(localizer: "LearnedLocalizer", scene: str) -> "Camera":
    """The camera of a scene's recording."""
    return _scene(localizer, scene).adjusted_camera


def draw_estimate(
    image: NDArray[np.uint8], estimate: "PoseEstimate", camera: "Camera", legend: bool = True
) -> NDArray[np.uint8]:
    """Draw the inlier scene points at the estimated pose, coloured by depth.

    The camera may have any size with the aspect ratio of the image. Without a pose nothing is
    drawn.
    """
    height, width = image.shape[:2]
    if estimate.base_from_camera is None or estimate.points_m is None:
        return image.copy()
    points = estimate.base_from_camera.inverse().apply(estimate.points_m)
    points = points[np.argsort(-points[:, 2])]  # near points cover far ones
    pixels = camera.resized(width, height).project(points)
    radius = max(1.5, min(width, height) / 110)
    return overlay_points(
        image, pixels, points[:, 2], radius, legend="depth (m)" if legend else None
    )


def draw_landmarks(
    image: NDArray[np.uint8],
    estimate: "PoseEstimate",
    localizer: "LearnedLocalizer",
    legend: bool = True,
) -> NDArray[np.uint8]:
    """Draw the landmarks detected in an image, coloured by reprojection error.

    The result is twice the size. The estimate was made with the camera of the scene; without a pose
    nothing is drawn.
    """
    import cv2

    height, width = 2 * image.shape[0], 2 * image.shape[1]
    large = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.uint8)
    errors = landmark_errors(estimate, localizer)
    if errors is None:
        return large
    pixels = resize_pixels(errors.pixels, height / errors.height)
    text = "reprojection error (px)" if legend else None
    return overlay_points(large, pixels, errors.errors_px, 3.0, (0.0, 1.0), text)


@dataclass(frozen=True, eq=False)
class LandmarkErrors:
    """Reprojection errors of the landmarks in an image."""

    pixels: NDArray[np.float64]
    """(n, 2) detections in the working image."""
    projected: NDArray[np.float64]
    """(n, 2) projections of their scene points; NaN behind the camera."""
    errors_px: NDArray[np.float64]
    """(n,) pixels of the working image; NaN behind the camera."""
    height: int
    """Height of the working image."""


def landmark_errors(
    estimate: "PoseEstimate",
    localizer: "LearnedLocalizer",
    camera: "Camera | None" = None,
    base_from_camera: "SE3 | None" = None,
) -> LandmarkErrors | None:
    """Compute the reprojection errors of the landmarks detected in an image.

    The camera is by default that of the scene, the pose that of the estimate. Returns None if the
    estimate has no pose or no landmarks.
    """
    pose = base_from_camera or estimate.base_from_camera
    if pose is None or estimate.scene is None or estimate.base_from_camera is None:
        return None
    if estimate.pixels is None or estimate.points_m is None:
        return None
    scene = _scene(localizer, estimate.scene)
    short_side = localizer.contents.short_side
    working_camera = (camera or scene.adjusted_camera).short_side_resized(short_side)
    points = scene.frame.camera_among_points(pose).inverse().apply(estimate.points_m)
    projected = working_camera.project(points)
    errors = np.linalg.norm(estimate.pixels - projected, axis=1)
    return LandmarkErrors(estimate.pixels, projected, errors, working_camera.height)


def draw_residuals(
    image: NDArray[np.uint8], errors: LandmarkErrors, scale: float = 1.0
) -> tuple[NDArray[np.uint8], int]:
    """Draw landmarks, coloured by their residual, with lines from detections to projections.

    The image may have any size. `scale` are pixels of the camera's image per pixel of the working
    image; the legend is in pixels of the former. Returns the factor of the lines' length, too.
    """
    enlarged = image.shape[0] / errors.height
    pixels, limits = resize_pixels(errors.pixels, enlarged), (0.0, MAX_RESIDUAL_PX * scale)
    residuals = scale * errors.errors_px
    drawn = overlay_points(image, pixels, residuals, 3.5, limits, "residual (px)")
    return overlay_vectors(drawn, pixels, enlarged * (errors.projected - errors.pixels))


def _scene(localizer: "LearnedLocalizer", name: str) -> "LearnedScene":
    return next(scene for scene in localizer.contents.scenes if scene.name == name)
