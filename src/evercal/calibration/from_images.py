"""`calibrate`: where a camera is, from images of a scene that a store knows.

A camera that stands still (eye-to-hand) sees the scene from one spot. Its images share the errors
of the landmarks they see, so many images are hardly better than a few: what the images have in
common stays in the covariance, however many there are. A camera on the gripper (eye-in-hand) looks
from many spots; there the errors average over the spots.
"""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration, ErrorTerm, Mount
from evercal.calibration.located import (
    Fused,
    FusionOptions,
    Located,
    deviations,
    fuse,
    halves_apart,
    in_gripper_frame,
    locate,
)
from evercal.calibration.verdict import verdict
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, axis_deviation
from evercal.recordings import read_image

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer

Array = NDArray[np.float64]
SPOT_M, SPOT_RAD = 0.1, np.deg2rad(10.0)
"""Views closer than this see the same landmarks from the same side: they share their errors."""


@dataclass(frozen=True, eq=False)
class Images:
    """Images of one camera, with what is known about them."""

    images: Sequence[tuple[str, NDArray[np.uint8]]]
    """(name, (h, w, 3) uint8 RGB)."""
    camera: Camera | None = None
    """Intrinsics; None takes those of the scene that is found, scaled."""
    base_from_gripper: SE3 | None = None
    """(n,) where the gripper was at each image."""

    @classmethod
    def read(
        cls,
        paths: Sequence[str | os.PathLike[str]],
        camera: Camera | None = None,
        base_from_gripper: SE3 | None = None,
    ) -> Self:
        """Reads image files.

        Args:
            paths: of the images.
            camera: see `camera`.
            base_from_gripper: see `base_from_gripper`.

        Raises:
            InputError: a file is missing or no image.
        """
        read = [(os.fspath(path), read_image(Path(path))) for path in paths]
        return cls(read, camera, base_from_gripper)


def calibrate(
    localizer: "Localizer",
    given: Images,
    mount: Mount | None = None,
    options: FusionOptions | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> Calibration:
    """The pose of a camera from images.

    Args:
        localizer: of a store that knows the scene.
        given: images and, for a camera on the gripper, the gripper's poses.
        mount: None decides: with gripper poses and a camera that moves it is eye_in_hand.
        options: when a pose belongs to the others.
        on_image: called after each image.

    Returns:
        base_from_camera for eye_to_hand, gripper_from_camera for eye_in_hand.

    Raises:
        InputError: no image was located, or eye_in_hand without gripper poses.
    """
    grippers = given.base_from_gripper
    if grippers is not None and len(grippers) != len(given.images):
        raise InputError(
            f"{len(given.images)} images and {len(grippers)} robot poses: give one pose for every"
            " image"
        )
    if mount == "eye_in_hand" and grippers is None:
        raise InputError("eye_in_hand needs the gripper's pose at every image: give --robot-poses")
    located = locate(localizer, given.images, given.camera, on_image)
    if mount is None:
        mount = "eye_to_hand" if grippers is None or _stands_still(located) else "eye_in_hand"
    moved = located
    if mount == "eye_in_hand" and grippers is not None:
        moved = in_gripper_frame(located, grippers)
    fused = fuse(moved, options)
    lens = given.camera
    if lens is None:
        record = next(r for r in localizer.maps.scenes if r.name == fused.scene)
        height, width = given.images[0][1].shape[:2]
        lens = record.query_camera(None).resized(width, height)
    if mount == "eye_to_hand":
        covariance, terms = _from_one_spot(moved, fused)
    else:
        covariance, terms = _from_many_spots(located, moved, fused)
    found = Calibration(
        mount,
        fused.pose,
        covariance,
        "base" if mount == "eye_to_hand" else "gripper",
        "camera",
        lens,
        fused.uses,
        terms,
        _checks(moved, fused),
        "",
        {"command": "calibrate", "scene": fused.scene, "map": map_digest(localizer, fused.scene)},
        datetime.now(UTC).isoformat(timespec="seconds"),
    )
    return replace(found, verdict=" ".join([verdict(found), *_advice(found, fused)]))


def map_digest(localizer: "Localizer", scene: str) -> str:
    """Names the map of a scene: two answers from one map share its errors."""
    index = localizer.scenes.index(scene)
    keyframes = localizer.maps.keyframes[index]
    told = hashlib.sha256(scene.encode())
    if keyframes is not None:
        told.update(keyframes.base_from_camera.matrix().tobytes())
    return told.hexdigest()[:16]


def _stands_still(located: Sequence[Located]) -> bool:
    """Whether the camera did not move: no two thirds of its poses are further apart."""
    poses = [item.pose for item in located if item.found]
    if len(poses) < 2:
        return True
    off = deviations(SE3.stack(poses), fuse([i for i in located if i.found]).pose)
    distance = np.linalg.norm(off[:, :3], axis=1)
    turn = np.linalg.norm(off[:, 3:], axis=1)
    return bool(np.median(distance) < 0.01 and np.median(turn) < np.deg2rad(1.0))


def _from_one_spot(located: Sequence[Located], fused: Fused) -> tuple[Array, tuple[ErrorTerm, ...]]:
    """Covariance of a camera that stands still: what one image has, plus the scatter's share."""
    kept = fused.kept(located)
    shared = np.mean([item.covariance for item in kept], axis=0)
    own = fused.scatter / len(kept)
    terms = (
        _term("landmarks and lens, shared by all images from this spot", shared),
        _term(f"scatter of {len(kept)} images", own),
    )
    return shared + own, terms


def _from_many_spots(
    located: Sequence[Located], moved: Sequence[Located], fused: Fused
) -> tuple[Array, tuple[ErrorTerm, ...]]:
    """Covariance of a camera on the gripper: the scatter among spots, and what one spot has."""
    kept = fused.kept(moved)
    spots = _spots([item.pose for item in fused.kept(located)])
    count = int(spots.max()) + 1
    own = np.mean([item.covariance for item in kept], axis=0) / count
    off = deviations(SE3.stack([item.pose for item in kept]), fused.pose)
    means = np.stack([off[spots == spot].mean(0) for spot in range(count)])
    # The scatter holds errors of the robot's poses, which the images know nothing of.
    scatter = means.T @ means / max(count - 1, 1) / count
    larger = np.maximum(np.diag(scatter), np.diag(own))
    scale = np.sqrt(larger / np.maximum(np.diag(own), 1e-18))
    covariance = own * np.outer(scale, scale) * _small_sample(count)
    terms = (
        _term(f"images from {count} spots", own),
        _term("scatter among spots, with the errors of the robot's poses", scatter),
    )
    return covariance, terms


def _small_sample(count: int) -> float:
    """Widens a covariance estimated from few spots so that Gaussian ellipsoids hold (Student)."""
    from scipy import stats

    freedom = max(count - 1, 1)
    return float((stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975)) ** 2)


def _spots(poses: Sequence[SE3]) -> NDArray[np.int64]:
    """(n,) number of the spot that each pose belongs to, in order of appearance."""
    centres: list[SE3] = []
    numbers = []
    for pose in poses:
        off = [deviations(SE3.stack([pose]), centre)[0] for centre in centres]
        near = [
            i
            for i, d in enumerate(off)
            if np.linalg.norm(d[:3]) < SPOT_M and np.linalg.norm(d[3:]) < SPOT_RAD
        ]
        if not near:
            centres.append(pose)
            near = [len(centres) - 1]
        numbers.append(near[0])
    return np.array(numbers)


def _term(name: str, covariance: Array) -> ErrorTerm:
    return ErrorTerm(name, *axis_deviation(covariance))


def _checks(moved: Sequence[Located], fused: Fused) -> Mapping[str, Any]:
    """Repeatability, and what `check` needs to compare later images."""
    kept = fused.kept(moved)
    halves = halves_apart(SE3.stack([item.pose for item in kept]))
    found: dict[str, Any] = {
        "images_given": len(moved),
        "images_used": len(kept),
        "image_scatter": fused.scatter.tolist(),
    }
    if halves is not None:
        found |= {"repeatability_mm": halves[0], "repeatability_deg": halves[1]}
    return found


def _advice(found: Calibration, fused: Fused) -> list[str]:
    """What would make the answer better."""
    used, lost = int(fused.used.sum()), int((~fused.used).sum())
    told = []
    if lost > used:
        told.append(
            f"{lost} of {used + lost} images were left out: the camera may have been moved between"
            " them, see the reasons."
        )
    if used == 1:
        told.append("It rests on one image: give five or more to see how well they agree.")
    elif found.mount == "eye_to_hand" and used >= 5:
        told.append(
            "More images from this spot will not help: what remains is shared by all of them."
            " Keyframes nearer to the camera's view would (learn a recording that comes closer)."
        )
    return told
