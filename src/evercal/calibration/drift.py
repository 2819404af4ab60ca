"""Has a camera been moved since it was calibrated?

Images of one camera in one map share the map's errors, and they cancel between two answers from
nearly one spot. A shift is therefore known better than either pose: to the scatter of the images
and a floor for what changes with light and with the things in view.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration, ImageUse
from evercal.calibration.from_images import map_digest
from evercal.calibration.located import Fused, Located, deviations, fuse, length_mm_deg, locate
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, axis_deviation

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DriftOptions:
    """When a camera counts as moved."""

    confidence: float = 0.99
    """Least confidence that it moved at all."""
    least_mm: float = 0.7
    """Smaller shifts are never called a move, millimetres."""
    least_deg: float = 0.04
    """And smaller turns, degrees; one of the two must be exceeded."""
    floor_mm: float = 0.2
    """Standard deviation per axis of what light and moved things do to a pose, millimetres."""
    floor_deg: float = 0.008
    """The same for the rotation, degrees."""
    usual_scatter_mm: float = 0.4
    """Scatter of a single image per axis where too few images tell it, millimetres."""
    usual_scatter_deg: float = 0.01
    """The same for the rotation, degrees."""
    usual_weight: float = 5.0
    """How many images' worth that usual scatter counts."""


@dataclass(frozen=True, eq=False)
class Shift:
    """How far a camera is from where it was."""

    reference_from_now: SE3
    """Pose of the camera as it stands now in the camera frame of the reference."""
    translation_mm: float
    """Length of its translation."""
    rotation_deg: float
    """Angle of its rotation."""
    sigma_mm: float
    """Standard deviation per axis."""
    sigma_deg: float
    """The same for the rotation."""
    confidence: float
    """That it moved at all, 0 to 1."""
    moved: bool
    """Whether it counts as moved."""
    same_map: bool
    """Whether both poses come from one map, so that its errors cancel."""


def check(
    localizer: "Localizer",
    images: Sequence[tuple[str, NDArray[np.uint8]]],
    reference: Calibration,
    camera: Camera | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> tuple[Shift, tuple[ImageUse, ...]]:
    """Whether a camera stands where its calibration says.

    Args:
        localizer: of a store that knows the scene.
        images: (name, (h, w, 3) uint8 RGB) of the camera as it is now.
        reference: its calibration.
        camera: intrinsics; those of the reference when left out.
        on_image: called after each image.

    Returns:
        The shift, and what became of every image.

    Raises:
        InputError: no image was located, or the reference is a camera on the gripper.
    """
    located = locate(localizer, images, camera or reference.camera, on_image)
    fused = fuse(located)
    return shift_between(reference, fused, located, localizer), fused.uses


def shift_between(
    reference: Calibration,
    fused: Fused,
    located: list[Located],
    localizer: "Localizer",
    options: DriftOptions | None = None,
) -> Shift:
    """Compares a camera with its reference.

    Args:
        reference: base_from_camera as it was, from `calibrate` or from elsewhere.
        fused: the camera now.
        located: the images it was put together from.
        localizer: that located them.
        options: when it counts as moved.

    Raises:
        InputError: the reference is a camera on the gripper.
    """
    from scipy import stats

    options = options or DriftOptions()
    if reference.mount != "eye_to_hand":
        raise InputError(
            "the reference is a camera on the gripper, whose pose in the base changes with every"
            " move; give the calibration of a camera that stands still"
        )
    same = reference.source.get("map") == map_digest(localizer, fused.scene)
    off = deviations(SE3.stack([fused.pose]), reference.parent_from_child)[0]
    count = int(fused.used.sum())
    floor = [(options.floor_mm / 1000) ** 2] * 3 + [np.deg2rad(options.floor_deg) ** 2] * 3
    seen = [(fused.scatter, count)]
    if same:
        # One camera in one map: its images scatter alike before and now.
        before = int(reference.checks.get("images_used", 1))
        seen.append((np.array(reference.checks.get("image_scatter", np.zeros((6, 6)))), before))
        scatter = _scatter(seen, options)
        covariance = scatter / count + scatter / before + np.diag(floor)
    else:
        kept = [item.covariance for item in fused.kept(located)]
        covariance = _scatter(seen, options) / count + np.diag(floor)
        covariance = covariance + reference.covariance + np.mean(kept, axis=0)
    confidence = float(stats.chi2.cdf(off @ np.linalg.solve(covariance, off), 6))
    millimetres, degrees = length_mm_deg(off)
    visible = millimetres > options.least_mm or degrees > options.least_deg
    return Shift(
        reference.parent_from_child.inverse() @ fused.pose,
        millimetres,
        degrees,
        *axis_deviation(covariance),
        confidence,
        bool(visible and confidence >= options.confidence),
        same,
    )


def _scatter(seen: Sequence[tuple[Array, int]], options: DriftOptions) -> Array:
    """Scatter of one image: as measured, drawn to the usual one where few images measured it.

    Args:
        seen: scatters (6, 6) with the number of images that each was measured on.
        options: with the usual scatter.
    """
    usual = [(options.usual_scatter_mm / 1000) ** 2] * 3
    usual += [np.deg2rad(options.usual_scatter_deg) ** 2] * 3
    total, weight = options.usual_weight * np.diag(usual), options.usual_weight
    for scatter, count in seen:
        total, weight = total + (count - 1) * scatter, weight + count - 1
    return total / weight
