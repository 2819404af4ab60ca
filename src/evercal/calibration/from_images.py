"""`calibrate`: the pose of a camera from images of a mapped scene.

A camera that stands still (eye-to-hand) observes the scene from one spot. Its images share the
errors of their landmarks, so that part of the covariance does not fall with their number. A camera
on the gripper (eye-in-hand) observes from many spots, and errors average over the spots.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, get_args

import numpy as np

from evercal.calibration.calibration import Calibration, ErrorTerm, largest_term
from evercal.calibration.held_thing.held_again import held_again
from evercal.calibration.located import (
    Fused,
    ImagePose,
    deviations,
    fuse,
    halves_apart,
    in_parent_frame,
    locate,
    of_cause,
    shows_held_thing,
)
from evercal.calibration.verdict import verdict
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, cross_matrix, pose_distance
from evercal.geometry.camera import COEFFICIENTS
from evercal.localization.estimate import Cause
from evercal.localization.intrinsics import STATED, cameras_in_scenes
from evercal.recordings.image_files import image_files
from evercal.recordings.images import Picture, as_rgb, pixels_of
from evercal.recordings.poses.pairing import poses_of_images
from evercal.robot.mount import MountName
from evercal.typing import Array, IntArray, PathLike

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer

CONTRADICTED_PX = 1.0
"""Stated intrinsics are replaced if the estimate moves rays by more than this, in pixels."""
SPOT_M, SPOT_RAD = 0.1, np.deg2rad(10.0)
"""Views closer than this observe the same landmarks, so they share their errors."""


ImageSource = PathLike | np.ndarray | Sequence[PathLike] | Sequence[np.ndarray]
"""A folder, an image file or an array (H, W, 3), or several files or arrays."""


@dataclass(frozen=True, eq=False)
class Images:
    """Images of one camera, with intrinsics and gripper poses if known."""

    images: Sequence[tuple[str, Picture]]
    """Names and pictures, which are read one at a time."""
    camera: Camera | None = None
    """Intrinsics. None: those of the camera that recorded the scene, or of another of its model."""
    base_from_gripper: SE3 | None = None
    """(n,) gripper pose at each image."""
    notes: tuple[str, ...] = ()
    """How poses and images were paired."""

    @classmethod
    def of(
        cls,
        source: ImageSource,
        camera: Camera | None = None,
        robot_poses: PathLike | SE3 | None = None,
        convention: str | None = None,
    ) -> Self:
        """Take images from files or arrays, see `Map.calibrate`."""
        single = isinstance(source, str | os.PathLike) or (
            isinstance(source, np.ndarray) and source.ndim < 4
        )
        items: list[Any] = [source] if single else [*source]  # pyright: ignore[reportGeneralTypeIssues]
        if not items or isinstance(items[0], str | os.PathLike):
            files = image_files(items)
            poses = robot_poses
            notes = []
            if isinstance(poses, str | os.PathLike):
                poses, notes = poses_of_images(Path(poses), files, convention)
            return cls(
                [(str(path), path) for path in files], camera, poses, tuple(notes)
            )
        if isinstance(robot_poses, str | os.PathLike):
            raise InputError(
                f"{robot_poses}: a file of robot poses is paired with image files by name, time or"
                " order; give poses (n,) with images from arrays"
            )
        arrays = [(f"image {i}", as_rgb(image)) for i, image in enumerate(items)]
        return cls(arrays, camera, robot_poses)


def calibrate(
    localizer: "Localizer",
    given: Images,
    mount: MountName | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> Calibration:
    """Estimate the pose of a camera from images of a mapped scene, see `Map.calibrate`.

    `mount` is eye_in_hand by default if there are gripper poses and the camera moves.
    """
    grippers = given.base_from_gripper
    if grippers is not None and len(grippers) != len(given.images):
        raise InputError(
            f"{len(given.images)} images and {len(grippers)} robot poses: give one pose for every"
            " image"
        )
    if mount == "eye_in_hand" and grippers is None:
        raise InputError(
            "eye_in_hand needs the gripper's pose at every image: give --robot-poses"
        )
    located = locate(localizer, given.images, given.camera, on_image)
    held = shows_held_thing(localizer, located, grippers)
    if held and mount == "eye_in_hand":
        raise InputError(
            "eye_in_hand: the gripper holds the scene, which shows fixed cameras only"
        )
    if mount is None:
        still = held or grippers is None or _stands_still(located)
        mount = "eye_to_hand" if still else "eye_in_hand"
    moved = located
    parents = None
    if grippers is not None and (held or mount == "eye_in_hand"):
        parents = grippers if held else grippers.inverse()
        moved = in_parent_frame(located, parents)
    fused = fuse(moved)
    scene = localizer.contents.metric_scene(fused.scene)
    first = pixels_of(fused.select(given.images)[0][1])
    source = {
        "command": "calibrate",
        "scene": fused.scene,
        "map": scene.digest,
        "intrinsics": "map" if given.camera is None else "given",
    }
    stated = cameras_in_scenes(given.camera, first, [scene])[0]
    camera = estimated_camera(fused.select(located), stated)
    if (
        held
        and grippers is not None
        and (another := held_again(located, grippers)) is not None
    ):
        calibration = another.solution.calibration()
        own = in_parent_frame(of_cause(located, lens=True), grippers)
        shown = [item.covariance for item in own if item.is_located]
        lens = np.mean(shown, axis=0) / len(shown)
        calibration = replace(
            calibration,
            covariance=calibration.covariance + lens,
            error_terms=(*calibration.error_terms, ErrorTerm.of("lens", lens)),
            camera=camera.resized(first.shape[1], first.shape[0]),
            source=source,
        )
        return replace(calibration, verdict=f"{calibration.verdict} {another.sentence}")
    if parents is None:
        covariance, terms = _from_one_spot(moved, fused)
    else:
        base = scene.frame.base_covariance
        covariance, terms = _from_many_spots(located, moved, fused, parents, base)
    checks: dict[str, Any] = {
        "images_given": len(moved),
        "images_used": int(fused.used.sum()),
        # `check` compares it with the scatter of later images.
        "image_scatter": fused.scatter.tolist(),
    }
    halves = halves_apart(SE3.stack([item.pose for item in fused.select(moved)]))
    if halves is not None:
        checks |= {"repeatability_mm": halves[0], "repeatability_deg": halves[1]}
    calibration = Calibration(
        mount=mount,
        parent_from_child=fused.pose,
        covariance=covariance,
        parent_frame="base" if mount == "eye_to_hand" else "gripper",
        camera=camera.resized(first.shape[1], first.shape[0]),
        images=fused.uses,
        error_terms=terms,
        checks=checks,
        source=source,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    sentences = [verdict(calibration), *_advice(calibration, fused, camera, stated)]
    return replace(calibration, verdict=" ".join(sentences))


def estimated_camera(used: Sequence[ImagePose], stated: Camera) -> Camera:
    """The stated intrinsics, or the median of the images' own if they contradict these."""
    cameras = [
        item.estimate.camera for item in used if item.estimate.camera is not None
    ]
    if not cameras:
        return stated
    rows = [[c.fx, c.fy, c.cx, c.cy, *c.coefficients] for c in cameras]
    fx, fy, cx, cy, *distortion = np.median(rows, axis=0).tolist()
    terms = tuple(distortion[: len(COEFFICIENTS[stated.model])])
    median = replace(stated, fx=fx, fy=fy, cx=cx, cy=cy, distortion=terms)
    across = np.linspace(0, 1, 5)[:, None] * [stated.width - 1, stated.height - 1]
    pixels = np.stack(np.meshgrid(*across.T), -1)
    # Compare angles between rays: the principal point trades against the rotation.
    shift = median.unproject(pixels) - stated.unproject(pixels)
    off = np.nanmax(
        np.linalg.norm((shift - np.nanmean(shift, (0, 1)))[..., :2], axis=-1)
    )
    return median if stated.fx * off > CONTRADICTED_PX else stated


def _stands_still(located: Sequence[ImagePose]) -> bool:
    fused = fuse(located)
    items = [item for item in located if item.is_located]
    if len(items) < 2:
        raise InputError(
            "one located image does not show whether the camera moves with the gripper: state it"
            " with --mount, or give images of more gripper poses"
        )
    off = deviations(SE3.stack([item.pose for item in items]), fused.pose)
    metres, radians = np.median(np.linalg.norm(off.reshape(-1, 2, 3), axis=2), axis=0)
    return bool(metres < 0.01 and radians < np.deg2rad(1.0))


def _from_one_spot(
    located: Sequence[ImagePose], fused: Fused
) -> tuple[Array, tuple[ErrorTerm, ...]]:
    used = fused.select(located)
    shared = np.mean([item.covariance for item in used], axis=0)
    own = fused.scatter / len(used)
    name = (
        f"scatter of {len(used)} images"
        if len(used) > 1
        else "scatter (unknown from one image)"
    )
    return shared + own, (*_by_cause(used), ErrorTerm.of(name, own))


def _from_many_spots(
    located: Sequence[ImagePose],
    moved: Sequence[ImagePose],
    fused: Fused,
    parent_from_scene: SE3,
    base_covariance: Array | None,
) -> tuple[Array, tuple[ErrorTerm, ...]]:
    """Covariance of a camera that moves in its scene: scatter among spots, one spot, the base."""
    from scipy import stats

    used = fused.select(moved)
    cameras = [item.pose for item in fused.select(located)]
    spots = _spots(cameras)
    count = int(spots.max()) + 1
    base = np.zeros((6, 6)) if base_covariance is None else base_covariance
    parents = fused.select(list(parent_from_scene))
    slopes = np.stack(
        [_by_scene_motion(p, c) for p, c in zip(parents, cameras, strict=True)]
    )
    shared = slopes.mean(0) @ base @ slopes.mean(0).T
    whole = np.mean([item.covariance for item in used], axis=0)
    own = (whole - (slopes @ base @ slopes.transpose(0, 2, 1)).mean(0)) / count
    off = deviations(SE3.stack([item.pose for item in used]), fused.pose)
    means = np.stack([off[spots == spot].mean(0) for spot in range(count)])
    freedom = max(count - 1, 1)
    # The scatter contains errors of the robot's poses, which the images do not show.
    scatter = means.T @ means / freedom / count
    larger = np.maximum(np.diag(scatter), np.diag(own))
    scale = np.sqrt(larger / np.maximum(np.diag(own), 1e-18))
    # Student factor of a covariance that was estimated from few spots.
    student = float((stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975)) ** 2)
    covariance = own * np.outer(scale, scale) * student
    terms = [term for term in _by_cause(used, count) if term.name != "base frame"]
    name = f"arm, and scatter among {count} spots"
    return covariance + shared, (
        *terms,
        ErrorTerm.of("base frame", shared),
        ErrorTerm.of(name, covariance - own),
    )


def _by_scene_motion(parent_from_scene: SE3, scene_from_camera: SE3) -> Array:
    rotation = parent_from_scene.rotation_matrix()
    slope = np.zeros((6, 6))
    slope[:3, :3] = rotation
    slope[:3, 3:] = -rotation @ cross_matrix(scene_from_camera.translation_m)
    slope[3:, 3:] = scene_from_camera.rotation_matrix().T
    return slope


def _by_cause(used: Sequence[ImagePose], spots: int = 1) -> tuple[ErrorTerm, ...]:
    """The mean covariance of the images by cause, over the number of spots."""
    total = {name: np.zeros((6, 6)) for name in get_args(Cause)}
    for item in used:
        terms = item.estimate.terms
        if not terms and item.estimate.covariance is not None:
            total["view"] += item.estimate.covariance
        for term in terms:
            total[term.name] += term.covariance
    count = len(used) * spots
    return tuple(
        ErrorTerm.of(name, covariance / count) for name, covariance in total.items()
    )


def _spots(poses: Sequence[SE3]) -> IntArray:
    centres: list[SE3] = []
    numbers = []
    for pose in poses:
        distances = (pose_distance(centre, pose) for centre in centres)
        near = (
            i for i, (m, rad) in enumerate(distances) if m < SPOT_M and rad < SPOT_RAD
        )
        numbers.append(next(near, len(centres)))
        if numbers[-1] == len(centres):
            centres.append(pose)
    return np.array(numbers)


def _advice(
    calibration: Calibration, fused: Fused, camera: Camera, stated: Camera
) -> list[str]:
    advice = []
    if camera != stated:
        advice.append(
            f"The stated intrinsics (focal length {stated.fx:.1f} px) do not fit the images, which"
            f" suggest {camera.fx:.1f} px: the estimated intrinsics were used."
        )
    advice += _lens_advice(calibration)
    if calibration.source["intrinsics"] == "map" and camera == stated:
        advice.append(
            f"The intrinsics are those of the camera that recorded {fused.scene}: give --camera if"
            " another camera took these images."
        )
    used = int(fused.used.sum())
    lost = int((~fused.used).sum())
    if lost > used:
        advice.append(
            f"{lost} of {used + lost} images were rejected: the camera may have moved between them,"
            " see the reasons."
        )
    if used == 1:
        advice.append(
            "It rests on one image: give five or more to measure their scatter."
        )
    elif not calibration.on_gripper and used >= 5:
        near = largest_term(calibration.error_terms)[0] in ("view", "map")
        advice.append(
            "More images from this spot will not help: the remaining error is common to all of"
            " them." + (" Keyframes nearer to the camera's view would." if near else "")
        )
    return advice


def _lens_advice(calibration: Calibration) -> list[str]:
    name, share = largest_term(calibration.error_terms)
    if name != "lens":
        return []
    moves = calibration.on_gripper
    if calibration.source["intrinsics"] == "given":
        known = (
            f"--camera counts as known to {100 * STATED.focal:g} % of the focal length"
        )
        more = (
            "images from more spots determine"
            if moves
            else "a view with more depth determines"
        )
        advice = f"{known}; {more} it better"
    else:
        advice = (
            "give --camera with intrinsics from images of a board ('evercal detect')"
        )
        advice += ", or images from more spots" if moves else ""
    percent = f"{100 * share:.0f} %"
    return [
        f"The lens is the largest term, {percent} of the position's variance: {advice}."
    ]
