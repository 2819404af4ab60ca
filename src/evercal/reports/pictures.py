"""An answer drawn into its image."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from evercal.geometry import SE3, Camera
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
    from evercal.reports import overlay_points

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

    from evercal.reports import overlay_points

    height, width = 2 * image.shape[0], 2 * image.shape[1]
    large = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.uint8)
    found = landmark_errors(estimate, localizer)
    if found is None:
        return large
    at = (found.pixels + 0.5) * (height / found.height) - 0.5
    words = "reprojection error (px)" if legend else None
    return overlay_points(large, at, found.errors_px, 3.0, (0.0, 1.0), words)


@dataclass(frozen=True, eq=False)
class LandmarkErrors:
    """How far the landmarks of an image lie from where a camera pose puts them."""

    pixels: NDArray[np.float64]
    """(n, 2) where they were found in the working image."""
    errors_px: NDArray[np.float64]
    """(n,) pixels of the working image; nan where the pose puts one behind the camera."""
    height: int
    """Of the working image."""


def landmark_errors(
    estimate: "PoseEstimate",
    localizer: "Localizer",
    camera: "Camera | None" = None,
    base_from_camera: "SE3 | None" = None,
) -> LandmarkErrors | None:
    """Reprojection errors of the landmarks that were found in an image.

    Args:
        estimate: the answer for the image; None is returned without a pose.
        localizer: that gave it.
        camera: the intrinsics that it was located with; None for the scene's own.
        base_from_camera: the pose to judge by; that of the answer when None.
    """
    pose = base_from_camera or estimate.base_from_camera
    if estimate.pixels is None or estimate.points_m is None or estimate.base_from_camera is None:
        return None
    assert pose is not None, "the answer has one"
    record = next(r for r in localizer.maps.scenes if r.name == estimate.scene)
    lens = record.query_camera(camera).short_side_resized(localizer.maps.short_side)
    among = record.camera_among_landmarks(pose)
    expected = lens.project(among.inverse().apply(estimate.points_m))
    errors = np.linalg.norm(estimate.pixels - expected, axis=1)
    return LandmarkErrors(estimate.pixels, errors, lens.height)
