"""Refresh the map of a scene from new images of it: locate, compare, verify."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, average_poses
from evercal.localization.estimate import PoseEstimate
from evercal.localization.learned import localize_picture
from evercal.localization.localizer import Localizer
from evercal.mapping.prepared_frames import WorkingSize
from evercal.mapping.refresh import RefreshOptions, refreshed
from evercal.mapping.scene_map import SceneMap
from evercal.mapping.selection import spread_poses
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame
from evercal.recordings.images import Picture
from evercal.typing import Array

LEAST_IMAGES = 5
"""Located images that a refresh takes, at least."""
PRECISE_M, PRECISE_RAD = 0.01, np.deg2rad(1.0)
"""Standard deviation of a pose, per axis, above which an image is left out."""
VERIFIED = 4
"""Every fourth located image is left out of the map and verifies it."""
WORSE = 0.1
"""Share of these images that the refreshed map may lose."""


@dataclass(frozen=True)
class RefreshReport:
    """Outcome of a refresh, as JSON values."""

    scene: str
    seconds: float
    images: int
    """Images given."""
    located: int
    """Images that were located precisely."""
    left_out: dict[str, str]
    """Reason why an image was left out, by name."""
    landmarks_checked: int
    """Landmarks that the images should show."""
    landmarks_gone: int
    """Landmarks among them that were removed."""
    keyframes_left: int
    """Keyframes that were removed."""
    keyframes_added: int
    memory_bytes: int
    """Size of the keyframes of this scene."""
    verified: int
    """Images outside the map that were located before and after."""
    shift_mm: float | None
    """Their mean motion by the refresh: the shift of the base frame. None where the unit of length
    is unknown, as `shift_sigma_mm`."""
    shift_deg: float
    shift_sigma_mm: float | None
    """Standard deviation of that shift, which is part of every later covariance."""
    shift_sigma_deg: float


_NewImage = tuple[Frame, SE3, Camera | None]
"""A frame posed in the frame of the keyframes, its base_from_camera, and its stated intrinsics."""


def refresh_scene(
    localizer: Localizer,
    images: Sequence[tuple[str, Picture]],
    cameras: Sequence[Camera | None] | None = None,
    options: RefreshOptions | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> tuple[SceneMap, RefreshReport]:
    """Refresh the scene that most of the images, with their names, show.

    The intrinsics of each image are by default those of the camera that recorded the scene. Too few
    located images, or a refreshed map that would locate fewer of them, raise `InputError`.
    """
    began = time.perf_counter()
    options = options or RefreshOptions()
    cameras = cameras or [None] * len(images)
    estimates = []
    for number, ((_, image), camera) in enumerate(zip(images, cameras, strict=True)):
        estimates.append(localize_picture(localizer, image, camera))
        on_progress("locating", number + 1, len(images))
    names = [e.scene for e in estimates if e.status == "ok" and e.scene is not None]
    shown = max(sorted(set(names)), key=names.count) if names else None
    contents = localizer.contents
    index = localizer.scenes.index(shown) if shown else -1
    scene = contents.scenes[index]
    located, left_out = _usable(images, cameras, estimates, scene)
    if len(located) < LEAST_IMAGES:
        reason = next(iter(left_out.values()), "")
        raise InputError(
            f"{len(located)} of {len(images)} images are located precisely; a refresh takes at"
            f" least {LEAST_IMAGES} ({reason}). The map is unchanged"
        )
    check = located[VERIFIED - 1 :: VERIFIED]
    used = [item for i, item in enumerate(located) if i % VERIFIED != VERIFIED - 1]
    poses = SE3.stack(
        [pose for frame, *_ in used if (pose := frame.base_from_camera) is not None]
    )
    frames = [used[i][0] for i in spread_poses(poses, options.most_frames)]
    size = WorkingSize(
        cells=contents.short_side, patches=localizer.options.patches_short_side
    )
    result = refreshed(scene, frames, contents.encoder, size, options, on_progress)
    scenes = [*contents.scenes]
    scenes[index] = result.scene
    after = Localizer(replace(contents, scenes=scenes), localizer.options)
    shift, sigma, verified = _verified(after, check, result.scene.name)
    covariance = np.diag(np.repeat(sigma**2, 3))
    known = scene.frame.base_covariance
    frame = replace(
        result.scene.frame,
        base_covariance=covariance if known is None else known + covariance,
    )
    updated = replace(result.scene, frame=frame)
    tangent = shift.log()
    report = RefreshReport(
        scene=scene.name,
        seconds=time.perf_counter() - began,
        images=len(images),
        located=len(located),
        left_out=left_out,
        landmarks_checked=result.checked,
        landmarks_gone=result.gone,
        keyframes_left=result.left,
        keyframes_added=result.added,
        memory_bytes=updated.keyframes.bytes,
        verified=verified,
        shift_mm=scene.in_metres(1000 * float(np.linalg.norm(tangent[:3]))),
        shift_deg=float(np.rad2deg(np.linalg.norm(tangent[3:]))),
        shift_sigma_mm=scene.in_metres(1000 * float(sigma[0])),
        shift_sigma_deg=float(np.rad2deg(sigma[1])),
    )
    return updated, report


def _usable(
    images: Sequence[tuple[str, Picture]],
    cameras: Sequence[Camera | None],
    estimates: Sequence[PoseEstimate],
    scene: SceneMap,
) -> tuple[list[_NewImage], dict[str, str]]:
    """Return the precisely located images of a scene, and why others are left out."""
    located = []
    left_out = {}
    for (name, image), stated, estimate in zip(images, cameras, estimates, strict=True):
        answer = estimate.uncertain_pose
        if estimate.status != "ok" or answer is None:
            left_out[name] = estimate.reason or estimate.status.replace("_", " ")
        elif estimate.scene != scene.name:
            left_out[name] = f"shows {estimate.scene}"
        elif not _precise(estimate, scene):
            left_out[name] = "located too roughly"
        else:
            pose = scene.frame.from_base(answer.pose)
            assert estimate.camera is not None, "an answer from a map"
            located.append(
                (Frame(name, image, estimate.camera, pose), answer.pose, stated)
            )
    return located, left_out


def _precise(estimate: PoseEstimate, scene: SceneMap) -> bool:
    """Whether the image determines its own pose well, apart from errors that all answers share."""
    own = sum(
        term.covariance for term in estimate.terms if term.name in ("view", "lens")
    )
    sigma = np.sqrt(np.diag(np.asarray(own)).reshape(2, 3).mean(1))
    metres = scene.at_room_scale(sigma[0])
    return bool(sigma[1] < PRECISE_RAD and metres < PRECISE_M)


def _verified(
    after: Localizer, check: Sequence[_NewImage], scene: str
) -> tuple[SE3, Array, int]:
    """Locate images outside the refreshed map; return shift, its standard deviation, and count."""
    moves = []
    for frame, before, camera in check:
        estimate = after.localize(frame.read_image(), camera)
        if (
            estimate.status == "ok"
            and estimate.scene == scene
            and estimate.base_from_camera
        ):
            moves.append(estimate.base_from_camera @ before.inverse())
    lost = len(check) - len(moves)
    if not moves or lost > max(1, WORSE * len(check)):
        raise InputError(
            f"the refreshed map locates {len(moves)} of {len(check)} images that the map located;"
            f" record more images of the changed places. The map is unchanged"
        )
    poses = SE3.stack(moves)
    shift = average_poses(poses)
    off = (shift.inverse() @ poses).log().reshape(-1, 2, 3)
    own = np.sqrt((off**2).mean((0, 2)) / max(len(moves) - 1, 1))
    size = np.sqrt((shift.log().reshape(2, 3) ** 2).mean(1))
    return shift, np.maximum(own, size), len(moves)
