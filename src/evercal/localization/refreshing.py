"""Refresh the map of a scene from new images of it: locate, compare, verify."""

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

import numpy as np

from evercal.classes import frozen
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, average_poses, length_mm_deg
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.localization.pictures import localize_picture
from evercal.mapping.prepared_frames import WorkingSize
from evercal.mapping.refresh import RefreshOptions, refreshed
from evercal.mapping.scene_map import SceneMap
from evercal.mapping.selection import spread_poses
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame
from evercal.recordings.images import NamedPictures
from evercal.typing import Array

LEAST_IMAGES = 5
"""Minimum number of located images of a refresh."""
PRECISE_M = 0.01
"""Standard deviation of a position per axis, metres, above which an image is left out."""
PRECISE_RAD = np.deg2rad(1.0)
"""Standard deviation of a rotation per axis, radians, above which an image is left out."""
VERIFIED = 4
"""Every fourth located image is left out of the map and verifies it."""
WORSE = 0.1
"""Share of these images that the refreshed map may lose."""


@frozen
class RefreshReport:
    """Outcome of a refresh, as JSON values."""

    scene: str
    seconds: float
    images: int
    """Number of images."""
    located: int
    """Number of precisely located images."""
    left_out: dict[str, str]
    """Reason why an image was left out, by name."""
    landmarks_checked: int
    """Number of landmarks that the images should show."""
    landmarks_gone: int
    """Number of removed landmarks among them."""
    keyframes_left: int
    """Number of removed keyframes."""
    keyframes_added: int
    """Number of new keyframes."""
    memory_bytes: int
    """Size of the keyframes of this scene."""
    verified: int
    """Number of images outside the map that were located before and after."""
    shift_mm: float | None
    """Their mean motion by the refresh: the shift of the base frame. None where the unit of length
    is unknown, as `shift_sigma_mm`."""
    shift_deg: float
    shift_sigma_mm: float | None
    """Standard deviation of that shift, which is part of every later covariance."""
    shift_sigma_deg: float


class NewImage(NamedTuple):
    """A precisely located image."""

    frame: Frame
    """With its pose in the frame of the keyframes."""
    pose_among_keyframes: SE3
    """base_from_camera of `frame`."""
    base_from_camera: SE3
    """As it was located."""
    camera: Camera | None
    """Stated intrinsics."""


def refresh_scene(
    localizer: Localizer,
    images: NamedPictures,
    cameras: Sequence[Camera | None] | None = None,
    options: RefreshOptions | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> tuple[SceneMap, RefreshReport]:
    """Refresh the scene that most of the images, with their names, show.

    The intrinsics of each image are by default those of the camera that recorded the scene. Too few
    located images, or a refreshed map that would locate fewer of them, raise `InputError`.
    """
    began = perf_counter()
    options = options or RefreshOptions()
    cameras = cameras or [None] * len(images)
    estimates = _estimates(localizer, images, cameras, on_progress)
    contents = localizer.contents
    index = _shown_scene(localizer, estimates)
    scene = contents.scenes[index]
    located, left_out = _usable(images, cameras, estimates, scene)
    if len(located) < LEAST_IMAGES:
        reason = next(iter(left_out.values()), "")
        raise InputError(
            f"{len(located)} of {len(images)} images are located precisely; a refresh takes at"
            f" least {LEAST_IMAGES} ({reason}). The map is unchanged"
        )
    verifying = located[VERIFIED - 1 :: VERIFIED]
    used = [image for i, image in enumerate(located) if i % VERIFIED != VERIFIED - 1]
    poses = SE3.stack([image.pose_among_keyframes for image in used])
    frames = [used[i].frame for i in spread_poses(poses, options.most_frames)]
    size = WorkingSize(
        cells=contents.short_side, patches=localizer.options.patches_short_side
    )
    result = refreshed(scene, frames, contents.encoder, size, options, on_progress)
    scenes = [*contents.scenes]
    scenes[index] = result.scene
    after = Localizer(replace(contents, scenes=scenes), localizer.options)
    shift = _verified(after, verifying, result.scene.name)
    updated = _with_base_covariance(result.scene, scene, shift)
    millimetres, degrees = length_mm_deg(shift.tangent)
    report = RefreshReport(
        scene=scene.name,
        seconds=perf_counter() - began,
        images=len(images),
        located=len(located),
        left_out=left_out,
        landmarks_checked=result.checked,
        landmarks_gone=result.gone,
        keyframes_left=result.left,
        keyframes_added=result.added,
        memory_bytes=updated.keyframes.bytes,
        verified=shift.images,
        shift_mm=scene.in_metres(millimetres),
        shift_deg=degrees,
        shift_sigma_mm=scene.in_metres(1000 * float(shift.sigma[0])),
        shift_sigma_deg=float(np.rad2deg(shift.sigma[1])),
    )
    return updated, report


def _estimates(
    localizer: Localizer,
    images: NamedPictures,
    cameras: Sequence[Camera | None],
    on_progress: OnProgress,
) -> list[PoseEstimate]:
    estimates = []
    for (_, image), camera in zip(images, cameras, strict=True):
        estimates.append(localize_picture(localizer, image, camera))
        on_progress("locating", len(estimates), len(images))
    return estimates


def _shown_scene(localizer: Localizer, estimates: Sequence[PoseEstimate]) -> int:
    """Index of the scene that most of the images show; the last one without any."""
    names = [e.scene for e in estimates if e.status == "ok" and e.scene is not None]
    if not names:
        return -1
    return localizer.scenes.index(max(sorted(set(names)), key=names.count))


def _usable(
    images: NamedPictures,
    cameras: Sequence[Camera | None],
    estimates: Sequence[PoseEstimate],
    scene: SceneMap,
) -> tuple[list[NewImage], dict[str, str]]:
    """Return the precisely located images of a scene, and why others are left out."""
    located = []
    left_out = {}
    for (name, image), stated, estimate in zip(images, cameras, estimates, strict=True):
        answer = estimate.uncertain_pose
        camera = estimate.camera
        if estimate.status != "ok" or not answer or not camera:
            left_out[name] = estimate.reason or estimate.status.replace("_", " ")
        elif estimate.scene != scene.name:
            left_out[name] = f"shows {estimate.scene}"
        elif not _precise(estimate, scene):
            left_out[name] = "located too roughly"
        else:
            pose = scene.frame.from_base(answer.pose)
            frame = Frame(name, image, camera, pose)
            located.append(NewImage(frame, pose, answer.pose, stated))
    return located, left_out


def _precise(estimate: PoseEstimate, scene: SceneMap) -> bool:
    """Whether the image determines its own pose well, apart from errors that all answers share."""
    covariance = np.zeros((6, 6))
    for term in estimate.terms:
        if term.name in ("view", "lens"):
            covariance = covariance + term.covariance
    variance = np.diag(covariance).reshape(2, 3)
    sigma = np.sqrt(variance.mean(1))
    metres = scene.at_room_scale(sigma[0])
    return bool(sigma[1] < PRECISE_RAD and metres < PRECISE_M)


class _Shift(NamedTuple):
    """Motion of located images by a refresh, which is that of the base frame."""

    tangent: Array
    """(6,) metres and radians."""
    sigma: Array
    """(2,) standard deviations per axis, metres and radians."""
    images: int
    """Number of images that were located before and after."""


def _verified(after: Localizer, images: Sequence[NewImage], scene: str) -> _Shift:
    """Locate images outside the refreshed map and return the shift of the base frame."""
    moves = []
    for image in images:
        estimate = after.localize(image.frame.read_image(), image.camera)
        pose = estimate.base_from_camera
        if estimate.status == "ok" and estimate.scene == scene and pose:
            moves.append(pose @ image.base_from_camera.inverse())
    lost = len(images) - len(moves)
    if not moves or lost > max(1, WORSE * len(images)):
        raise InputError(
            f"the refreshed map locates {len(moves)} of {len(images)} images that the map located;"
            f" record more images of the changed places. The map is unchanged"
        )
    poses = SE3.stack(moves)
    mean = average_poses(poses)
    tangent = mean.log()
    scatter = (mean.inverse() @ poses).log().reshape(-1, 2, 3)
    variance = (scatter**2).mean((0, 2))
    of_mean = np.sqrt(variance / max(len(moves) - 1, 1))
    squares = tangent.reshape(2, 3) ** 2
    size = np.sqrt(squares.mean(1))
    return _Shift(tangent, np.maximum(of_mean, size), len(moves))


def _with_base_covariance(
    refreshed_map: SceneMap, before: SceneMap, shift: _Shift
) -> SceneMap:
    """The refreshed map, whose base frame has the covariance of the shift, too."""
    covariance = np.diag(np.repeat(shift.sigma**2, 3))
    if before.frame.base_covariance is not None:
        covariance = before.frame.base_covariance + covariance
    frame = replace(refreshed_map.frame, base_covariance=covariance)
    return replace(refreshed_map, frame=frame)
