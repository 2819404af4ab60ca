"""An answer drawn into its image."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from evercal.geometry import Camera
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.localizer import Localizer


def scene_camera(localizer: "Localizer", scene: str) -> "Camera":
    """The camera that a scene was recorded with."""
    return next(record.camera for record in localizer.maps.scenes if record.name == scene)


def draw_estimate(
    image: NDArray[np.uint8], estimate: "PoseEstimate", camera: "Camera", legend: bool = True
) -> NDArray[np.uint8]:
    """The inlying scene points, seen from the estimated pose, coloured by depth.

    Args:
        image: (H, W, 3) uint8 RGB.
        estimate: the answer for it; without a pose nothing is drawn.
        camera: its intrinsics at any size of the same proportions.
        legend: whether to write down what the colours mean.

    Returns:
        A new image of the same size.
    """
    from evercal.drawing import overlay_points

    height, width = image.shape[:2]
    if estimate.base_from_camera is None or estimate.points_m is None:
        return image.copy()
    points = estimate.base_from_camera.inverse().apply(estimate.points_m)
    points = points[np.argsort(-points[:, 2])]  # far first: near points cover them
    pixels = camera.resized(width, height).project(points)
    radius = max(1.5, min(width, height) / 110)
    words = "depth (m)" if legend else None
    return overlay_points(image, pixels, points[:, 2], radius, legend=words)


def draw_landmarks(
    image: NDArray[np.uint8],
    estimate: "PoseEstimate",
    localizer: "Localizer",
    legend: bool = True,
) -> NDArray[np.uint8]:
    """The landmarks that were found in an image, coloured by their reprojection error.

    Args:
        image: (H, W, 3) uint8 RGB.
        estimate: the answer for it, where no camera was given or the scene's own; without a pose
            nothing is drawn.
        localizer: that gave it.
        legend: whether to write down what the colours mean.

    Returns:
        A new image, twice as large so that landmarks can be told apart.
    """
    import cv2

    from evercal.drawing import overlay_points

    height, width = 2 * image.shape[0], 2 * image.shape[1]
    large = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.uint8)
    if estimate.pixels is None or estimate.base_from_camera is None or estimate.points_m is None:
        return large
    record = next(r for r in localizer.maps.scenes if r.name == estimate.scene)
    camera = record.query_camera(None).short_side_resized(localizer.maps.short_side)
    adjusted = record.camera_among_landmarks(estimate.base_from_camera)
    expected = camera.project(adjusted.inverse().apply(estimate.points_m))
    residual = np.linalg.norm(estimate.pixels - expected, axis=1)
    at = (estimate.pixels + 0.5) * (height / camera.height) - 0.5
    words = "reprojection error (px)" if legend else None
    return overlay_points(large, at, residual, 3.0, (0.0, 1.0), words)
