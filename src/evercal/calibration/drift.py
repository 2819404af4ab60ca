"""`check`: test whether a camera has moved since it was calibrated.

Two poses of one camera in one map share the map's errors, which cancel in their difference. So a
shift is more accurate than either pose: to the scatter of the images, and a floor for changes of
light and of objects in view.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from evercal.calibration.calibration import Calibration, ImageUse
from evercal.calibration.comparison import (
    SAME_MAP,
    pooled_scatter,
    same_map_covariance,
)
from evercal.calibration.held_thing.held_again import LEAST_GRIPS, held_again
from evercal.calibration.located import (
    Fused,
    ImagePose,
    fuse,
    in_parent_frame,
    locate,
    mean_covariance,
    of_cause,
    shows_held_thing,
)
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, axis_deviation, deviations, length_mm_deg
from evercal.recordings.images import NamedPictures, pixels_of
from evercal.typing import Array

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer


CONFIDENCE = 0.99
"""Least confidence that a camera moved at all."""
_LEAST_MM = 0.7
"""Smaller shifts, millimetres, are no move."""
_LEAST_DEG = 0.04
"""Smaller rotations, degrees, are no move."""
_LEAST_FOCAL = 0.005
"""Smaller changes of the focal length are none, as a share."""
_CAMERA_OR_GRIP = (
    f"The camera, or the thing in the gripper: {LEAST_GRIPS} images that turn it about two axes"
    " show which of them moved."
)


@dataclass(frozen=True, eq=False)
class Shift:
    """Motion of a camera since its calibration."""

    reference_from_now: SE3
    """Pose of the camera now, in its camera frame at the time of the calibration."""
    translation_mm: float
    rotation_deg: float
    sigma_mm: float
    """Standard deviation per axis."""
    sigma_deg: float
    confidence: float
    """Probability that it moved at all, 0 to 1."""
    moved: bool
    same_map: bool
    """Whether both poses come from one map, so that its errors cancel."""
    images: tuple[ImageUse, ...] = ()
    note: str = ""
    """What else differs, or could: a thing that the gripper holds another way. Empty without."""


def check(
    localizer: "Localizer",
    images: NamedPictures,
    reference: Calibration,
    camera: Camera | None = None,
    on_image: Callable[[], object] = lambda: None,
    base_from_gripper: SE3 | None = None,
) -> Shift:
    """Test whether a camera has moved since its calibration, see `Map.check`."""
    require_fixed(reference)
    localizer = within_reference(localizer, reference)
    located = locate(localizer, images, camera or reference.camera, on_image)
    if not shows_held_thing(localizer, located, base_from_gripper):
        shift = shift_between(reference, fuse(located), located, localizer)
        notes = [lens_change(located, reference)]
        if shift.moved:
            notes.append(_moved_apart(localizer, images, located, reference))
        return replace(shift, note=" ".join(filter(None, notes)))
    assert base_from_gripper, "a held thing needs gripper poses"
    grip = held_again(located, base_from_gripper)
    if grip:
        calibration = grip.solution.calibration()
        covariance = calibration.covariance + reference.covariance
        pose = calibration.parent_from_child
        shift = shift_of(reference, pose, covariance, images=calibration.images)
        return replace(shift, note=grip.sentence)
    # The lens errs now as it did then. The map does not: the thing is seen from another side.
    located = in_parent_frame(of_cause(located, lens=False), base_from_gripper)
    shift = shift_between(reference, fuse(located), located, localizer)
    if shift.moved and sum(item.is_located for item in located) < LEAST_GRIPS:
        return replace(shift, note=_CAMERA_OR_GRIP)
    return shift


def lens_change(located: Sequence[ImagePose], reference: Calibration) -> str:
    """What the images show of a focal length that differs from the calibration's; or nothing."""
    lens = reference.camera
    ratios = []
    for item in located:
        own = item.estimate.camera
        if own and lens and lens.fits(*own.size):
            ratios.append(own.fx / lens.resized(*own.size).fx - 1)
    if not ratios:
        return ""
    change = float(np.median(ratios))
    if abs(change) < _LEAST_FOCAL:
        return ""
    return (
        f"The lens has changed: the focal length differs by {100 * change:+.1f} % from that of the"
        " calibration. Fix focus and zoom, and calibrate again."
    )


def _moved_apart(
    localizer: "Localizer",
    images: NamedPictures,
    located: Sequence[ImagePose],
    reference: Calibration,
) -> str:
    """What the images show of landmarks that did not move with the others; or nothing."""
    from evercal.localization.unmoved import unmoved

    stayed = []
    moved = []
    for (_, picture), item in zip(images, located, strict=True):
        estimate = item.estimate
        if estimate.scene is None or not item.is_located:
            continue
        scene = localizer.contents.scene(estimate.scene)
        image = pixels_of(picture)
        then = reference.parent_from_child
        camera = reference.camera
        share = unmoved(localizer, image, camera, scene, then, item.pose)
        stayed.append(share)
        moved.append(estimate.inlier_ratio)
    if not stayed or not np.median(stayed):
        return ""
    share = np.median(stayed) / (np.median(stayed) + np.median(moved))
    return (
        f"Not all of the scene has moved against the camera: {100 * (1 - share):.0f} % of the"
        f" landmarks have, {100 * share:.0f} % stand where they stood. Either things moved, such as"
        " a table with all on it, or the camera moved together with the rest."
    )


def shift_between(
    reference: Calibration,
    fused: Fused,
    located: list[ImagePose],
    localizer: "Localizer",
    confidence: float = CONFIDENCE,
) -> Shift:
    """Compare `fused`, the pose of a camera now from `located` images, with its calibration."""
    require_fixed(reference)
    scene = localizer.contents.metric_scene(fused.scene)
    same = reference.source.get("map") == scene.digest
    count = int(fused.used.sum())
    measured = [(fused.scatter, count)]
    if same:
        # One camera in one map: the scatter of its images is the same before and now.
        before = int(reference.checks.images_used or 1)
        stated = reference.checks.image_scatter or np.zeros((6, 6))
        measured.append((np.array(stated), before))
        covariance = same_map_covariance(measured)
        if scene.parent_frame == "gripper":
            covariance += mean_covariance(fused.select(located)) / count
    else:
        covariance = pooled_scatter(measured) / count + SAME_MAP
        by_map = mean_covariance(fused.select(located))
        covariance = covariance + reference.covariance + by_map
    shift = shift_of(reference, fused.pose, covariance, confidence, fused.uses)
    return replace(shift, same_map=same)


def within_reference(localizer: "Localizer", reference: Calibration) -> "Localizer":
    """The localizer within the scene that a camera was calibrated in, if it is there."""
    for scene in localizer.contents.scenes:
        named = scene.name == reference.source.get("scene")
        if named and scene.digest == reference.source.get("map"):
            return localizer.within([scene.name])
    return localizer


def require_fixed(reference: Calibration) -> None:
    """Refuse a camera on the gripper."""
    if reference.on_gripper:
        raise InputError(
            "the reference is a camera on the gripper, whose pose in the base changes with every"
            " move; give the calibration of a camera that stands still, or one with joint offsets"
        )


def shift_of(
    reference: Calibration,
    pose: SE3,
    covariance: Array,
    confidence: float = CONFIDENCE,
    images: tuple[ImageUse, ...] = (),
) -> Shift:
    """The shift of a camera that is now at `pose`; covariance (6, 6) is of their difference."""
    from scipy import stats

    off = deviations(SE3.stack([pose]), reference.parent_from_child)[0]
    probability = float(stats.chi2.cdf(off @ np.linalg.solve(covariance, off), 6))
    millimetres, degrees = length_mm_deg(off)
    sigma_mm, sigma_deg = axis_deviation(covariance)
    return Shift(
        reference_from_now=reference.parent_from_child.inverse() @ pose,
        translation_mm=millimetres,
        rotation_deg=degrees,
        sigma_mm=sigma_mm,
        sigma_deg=sigma_deg,
        confidence=probability,
        moved=probability >= confidence
        and (millimetres > _LEAST_MM or degrees > _LEAST_DEG),
        same_map=False,
        images=images,
    )
