"""Images of a calibration: located one by one, then fused robustly."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from evercal.calibration.calibration import ImageUse
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import (
    SE3,
    Camera,
    UncertainPose,
    average_poses,
    deviations,
    length_mm_deg,
    pose_distance_mm_deg,
)
from evercal.geometry.rays import fit_rays
from evercal.localization.intrinsics import cameras_in_scenes
from evercal.localization.pictures import localize_picture
from evercal.recordings.images import NamedPictures
from evercal.typing import Array, BoolArray, Pair

if TYPE_CHECKING:
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.localizer import Localizer

Item = TypeVar("Item")
_OUTLIER_SIGMAS = 5.0
"""Robust standard deviations from the mean beyond which a pose is an outlier."""
_LEAST_M = 0.002
"""Smaller distances from the mean, metres, are never outliers."""
_LEAST_RAD = np.deg2rad(0.15)
"""Smaller angles to the mean, radians, are never outliers."""


@frozen_arrays
class ImagePose:
    """One image with its estimate, and the pose of it that is fused."""

    name: str
    estimate: "PoseEstimate"
    pose: SE3
    """Pose to fuse: base_from_camera or gripper_from_camera. Identity if it was not located."""
    covariance: Array
    """(6, 6), as in `Calibration`."""
    base: str = ""
    """The first scene in the base of the image's scene."""

    @property
    def is_located(self) -> bool:
        """Whether there is a pose."""
        return self.estimate.base_from_camera is not None


@frozen_arrays
class Fused:
    """Robust mean of many poses of one transform."""

    pose: SE3
    scatter: Array
    """(6, 6) covariance of one pose about the others."""
    used: BoolArray
    """(n,) inliers among the images."""
    uses: tuple[ImageUse, ...]
    """(n,) use of every image, or the reason for rejecting it."""
    scene: str

    def select(self, items: Sequence[Item]) -> list[Item]:
        """Return the items of the used images."""
        return [item for item, used in zip(items, self.used, strict=True) if used]


def poses_of(items: Sequence[ImagePose]) -> SE3:
    """(n,) poses of images."""
    return SE3.stack([item.pose for item in items])


def mean_covariance(items: Sequence[ImagePose]) -> Array:
    """(6, 6) mean of the covariances of images."""
    return np.mean([item.covariance for item in items], axis=0)


def locate(
    localizer: "Localizer",
    images: NamedPictures,
    camera: Camera | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> list[ImagePose]:
    """Read and locate the named images one by one; `on_image` is called after each.

    Poses are for the intrinsics that are given, or those of the map: not for the ones that each
    image estimates for itself.
    """
    located = []
    contents = localizer.contents
    for name, image in images:
        base = ""
        estimate = localize_picture(localizer, image, camera)
        uncertain = estimate.uncertain_pose
        own = estimate.camera
        if not uncertain or estimate.scene is None:
            uncertain = UncertainPose(SE3.identity(), np.eye(6))
        else:
            base = contents.base_of(estimate.scene)
            if own:
                shape = np.empty((own.height, own.width), np.uint8)
                scene = contents.scene(estimate.scene)
                common = cameras_in_scenes(camera, shape, [scene])[0]
                turn = fit_rays(own, common).own_from_other
                uncertain = uncertain @ SE3.of(turn, np.zeros(3))
        located.append(
            ImagePose(name, estimate, uncertain.pose, uncertain.covariance, base)
        )
        on_image()
    return located


def in_parent_frame(
    located: Sequence[ImagePose], parent_from_scene: SE3
) -> list[ImagePose]:
    """Return the n images with `parent_from_camera` as the pose.

    `parent_from_scene` (n,) is gripper_from_base for a camera on the gripper, and base_from_gripper
    where the scene is a thing in the gripper.
    """
    moved = []
    for item, parent in zip(located, parent_from_scene, strict=True):
        pose = parent @ UncertainPose(item.pose, item.covariance)
        moved.append(replace(item, pose=pose.pose, covariance=pose.covariance))
    return moved


def of_cause(located: Sequence[ImagePose], lens: bool) -> list[ImagePose]:
    """The images with only the part of their covariance that is due to the lens, or only the rest.

    An estimate without terms has no such part, and keeps all of its covariance as the rest.
    """
    changed = []
    for item in located:
        terms = item.estimate.terms
        parts = [term.covariance for term in terms if (term.name == "lens") == lens]
        covariance = sum(parts, np.zeros((6, 6)))
        if not terms and not lens:
            covariance = item.covariance
        changed.append(replace(item, covariance=covariance))
    return changed


def shows_held_thing(
    localizer: "Localizer", located: Sequence[ImagePose], base_from_gripper: SE3 | None
) -> bool:
    """Whether the first located image shows a thing in the gripper, which needs gripper poses."""
    name = next((item.estimate.scene for item in located if item.is_located), None)
    held = name is not None and localizer.contents.scene(name).parent_frame == "gripper"
    if held and not base_from_gripper:
        raise InputError(
            f"scene {name} is a thing in the gripper: give the gripper's pose at every image with"
            " `robot_poses`"
        )
    return held


def fuse(located: Sequence[ImagePose]) -> Fused:
    """Fuse poses of one transform, with a reason for every image that is rejected."""
    names = Counter()
    bases = Counter()
    for item in located:
        if len({*item.estimate.alternatives_in}) > 1:
            raise InputError(f"{item.name}: {item.estimate.reason}")
        if item.is_located:
            names[item.base, item.estimate.scene] += 1
            bases[item.base] += 1
    if not names:
        first = located[0].estimate.reason if located else "no image was given"
        raise InputError(
            f"0 of {len(located)} images were located (the first: {first}); give sharp, well-lit"
            " images of a mapped scene"
        )
    base, scene = max(names, key=lambda name: (bases[name[0]], names[name], str(name)))
    reasons = [""] * len(located)
    for i, item in enumerate(located):
        if not item.is_located:
            reasons[i] = (
                f"{item.estimate.status.replace('_', ' ')}: {item.estimate.reason}"
            )
        elif item.base != base:
            reasons[i] = f"shows scene {item.estimate.scene}; most images show {scene}"
    usable = [i for i, reason in enumerate(reasons) if not reason]
    poses = SE3.stack([located[i].pose for i in usable])
    mean = average_poses(poses)
    off = deviations(poses, mean)
    far = _far(off)
    for row, i in enumerate(usable):
        if far[row]:
            millimetres, degrees = length_mm_deg(off[row])
            reasons[i] = (
                f"lies {millimetres:.1f} mm and {degrees:.2f} deg from the other images"
            )
    near = ~far
    if near.sum() >= 2:
        mean = average_poses(poses[near])
    off = deviations(poses, mean)
    scatter = off[near].T @ off[near] / max(1, near.sum() - 1)
    uses = []
    residual = dict(zip(usable, off, strict=True))
    for i, item in enumerate(located):
        size = length_mm_deg(residual[i]) if i in residual else (None, None)
        uses.append(ImageUse(item.name, not reasons[i], reasons[i], *size))
    used = np.array([not reason for reason in reasons])
    return Fused(mean, scatter, used, tuple(uses), str(scene))


def _far(off: Array) -> BoolArray:
    distance = np.linalg.norm(off.reshape(-1, 2, 3), axis=2)
    # For three Gaussian axes the median distance is 1.54 standard deviations.
    spread = np.median(distance, axis=0) / 1.54
    return (
        distance > np.maximum(_OUTLIER_SIGMAS * spread, (_LEAST_M, _LEAST_RAD))
    ).any(1)


def halves_apart(poses: SE3) -> Pair | None:
    """Return millimetres and degrees between the means of even and odd poses, at least four."""
    if len(poses) < 4:
        return None
    even = average_poses(poses[0::2])
    odd = average_poses(poses[1::2])
    return pose_distance_mm_deg(even, odd)
