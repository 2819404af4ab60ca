"""Images on their way to a calibration: located one by one, then put together robustly."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import ImageUse
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, average_poses, pose_distance_mm_deg, with_translation_by

if TYPE_CHECKING:
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.localizer import Localizer

Array = NDArray[np.float64]
Item = TypeVar("Item")


@dataclass(frozen=True)
class FusionOptions:
    """When a pose belongs to the others."""

    outlier_sigmas: float = 5.0
    """A pose further from the others than this many robust standard deviations is left out."""
    least_mm: float = 2.0
    """But none that is closer than this, millimetres."""
    least_deg: float = 0.15
    """And than this, degrees."""


@dataclass(frozen=True, eq=False)
class Located:
    """One image and where its camera was found."""

    name: str
    """Of the image."""
    estimate: "PoseEstimate"
    """The answer of the localizer."""
    pose: SE3
    """What is put together: base_from_camera, or gripper_from_camera. Identity where the estimate
    is not ok."""
    covariance: Array
    """(6, 6) of translation in the parent frame and rotation about camera axes."""

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return self.estimate.base_from_camera is not None


@dataclass(frozen=True, eq=False)
class Fused:
    """Many poses of one transform, put together."""

    pose: SE3
    """Single."""
    scatter: Array
    """(6, 6) covariance of one pose about the others."""
    used: NDArray[np.bool_]
    """(n,) which of the images it rests on."""
    uses: tuple[ImageUse, ...]
    """(n,) what became of every image."""
    scene: str
    """Name of the scene."""

    def kept(self, items: Sequence[Item]) -> list[Item]:
        """Those of (n,) things, one for each image, that belong to the images used."""
        return [item for item, used in zip(items, self.used, strict=True) if used]


def locate(
    localizer: "Localizer",
    images: Sequence[tuple[str, NDArray[np.uint8]]],
    camera: Camera | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> list[Located]:
    """Locates every image.

    Args:
        localizer: of a store that knows the scene.
        images: (name, (h, w, 3) uint8 RGB).
        camera: intrinsics; None takes those of the scene that is found, scaled.
        on_image: called after each.
    """
    found = []
    for name, image in images:
        estimate = localizer.localize(image, camera)
        pose, covariance = estimate.base_from_camera, estimate.covariance
        known = np.eye(6) if covariance is None else covariance
        found.append(Located(name, estimate, pose or SE3.identity(), known))
        on_image()
    return found


def in_gripper_frame(located: Sequence[Located], base_from_gripper: SE3) -> list[Located]:
    """The same images with `gripper_from_camera` as the pose.

    Args:
        located: n images.
        base_from_gripper: (n,) where the gripper was.
    """
    moved = []
    for item, gripper in zip(located, base_from_gripper, strict=True):
        covariance = with_translation_by(gripper.rotation_matrix().T, item.covariance)
        pose = gripper.inverse() @ item.pose
        moved.append(Located(item.name, item.estimate, pose, covariance))
    return moved


def fuse(located: Sequence[Located], options: FusionOptions | None = None) -> Fused:
    """One pose from many, in any order, with a reason for every image that is left out.

    Args:
        located: images that should all give the same pose.
        options: when a pose belongs to the others.

    Raises:
        InputError: no image was located.
    """
    options = options or FusionOptions()
    names = Counter(item.estimate.scene for item in located if item.found)
    if not names:
        first = located[0].estimate.reason if located else "no image was given"
        raise InputError(
            f"none of {len(located)} images was located (the first: {first}); give images of a"
            " place that the store knows, sharp and not too dark"
        )
    scene = max(names, key=lambda name: (names[name], str(name)))
    reasons = ["" for _ in located]
    for i, item in enumerate(located):
        if not item.found:
            reasons[i] = f"{item.estimate.status.replace('_', ' ')}: {item.estimate.reason}"
        elif item.estimate.scene != scene:
            reasons[i] = f"shows scene {item.estimate.scene}, most images show {scene}"
    usable = [i for i, reason in enumerate(reasons) if not reason]
    poses = SE3.stack([located[i].pose for i in usable])
    middle = average_poses(poses)
    off = deviations(poses, middle)
    far = _far(off, options)
    for place, i in enumerate(usable):
        if far[place]:
            millimetres, degrees = length_mm_deg(off[place])
            reasons[i] = f"lies {millimetres:.1f} mm and {degrees:.2f} deg from the other images"
    keep = ~far
    if keep.sum() >= 2:
        middle = average_poses(poses[keep])
    off = deviations(poses, middle)
    scatter = off[keep].T @ off[keep] / max(1, keep.sum() - 1)
    uses, residual = [], dict(zip(usable, off, strict=True))
    for i, item in enumerate(located):
        size = length_mm_deg(residual[i]) if i in residual else (None, None)
        uses.append(ImageUse(item.name, not reasons[i], reasons[i], *size))
    used = np.array([not reason for reason in reasons])
    return Fused(middle, scatter, used, tuple(uses), str(scene))


def deviations(poses: SE3, middle: SE3) -> Array:
    """(n, 6) of poses from one: translation in the parent frame, rotation about child axes."""
    shift = poses.translation_m - middle.translation_m
    turn = (middle.inverse() @ poses).log()[:, 3:]
    return np.concatenate([shift, turn], axis=1)


def _far(off: Array, options: FusionOptions) -> NDArray[np.bool_]:
    """Which poses lie far from the others: beyond robust deviations and a least distance."""
    far = np.zeros(len(off), bool)
    for part, least in (
        (off[:, :3], options.least_mm / 1000),
        (off[:, 3:], np.deg2rad(options.least_deg)),
    ):
        distance = np.linalg.norm(part, axis=1)
        # For three Gaussian axes the median distance is 1.54 standard deviations.
        spread = float(np.median(distance)) / 1.54
        far |= distance > max(options.outlier_sigmas * spread, least)
    return far


def length_mm_deg(off: Array) -> tuple[float, float]:
    """Millimetres and degrees of one deviation (6,)."""
    return 1000 * float(np.linalg.norm(off[:3])), float(np.rad2deg(np.linalg.norm(off[3:])))


def halves_apart(poses: SE3) -> tuple[float, float] | None:
    """Millimetres and degrees between the answers of every other pose and of the rest.

    Args:
        poses: (n,); None is returned for fewer than four.
    """
    if len(poses) < 4:
        return None
    first, second = (average_poses(poses[start::2]) for start in (0, 1))
    return pose_distance_mm_deg(first, second)
