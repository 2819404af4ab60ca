"""Detect recorded episodes whose images disagree with the stated camera pose."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from evercal.calibration.located import fuse, locate
from evercal.calibration.transform_file import read_transform
from evercal.classes import frozen
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance_mm_deg
from evercal.recordings.images import Picture, files_in
from evercal.recordings.load import load_recording, recognised

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer

_Shot = tuple[str, Picture, Camera | None, SE3]
"""Name, picture, intrinsics and stated base_from_camera of an image."""
POSE_FILES = ("calibration.json", "base_from_camera.txt")
"""Files of an episode's folder that state the pose of its camera."""


@frozen
class Episode:
    """Result for one episode."""

    name: str
    """Name of its folder."""
    verdict: Literal["right", "wrong", "unknown"]
    """Whether its stated camera pose fits its images; unknown if no image was located."""
    reason: str
    translation_mm: float | None = None
    """Distance between the stated pose and the images."""
    rotation_deg: float | None = None


def audit(
    localizer: "Localizer",
    folder: Path,
    stated: SE3 | None = None,
    images: int = 5,
    agreement: tuple[float, float] = (5.0, 0.5),
    on_episode: Callable[[], object] = lambda: None,
) -> list[Episode]:
    """Compare stated camera poses with images, episode by episode.

    Args:
        localizer: Localizer of a store that holds the scene.
        folder: Holds the episodes: recordings with camera poses, or images beside a
            `calibration.json` or a 4x4 matrix `base_from_camera.txt`.
        stated: base_from_camera of the episodes without a pose of their own.
        images: Images of an episode to locate.
        agreement: Largest difference that still agrees, millimetres and degrees.
        on_episode: Called after each episode.
    """
    audited = []
    for episode in episode_folders(folder):
        audited.append(
            _audited(localizer, episode, _shots(episode, stated, images), agreement)
        )
        on_episode()
    return audited


def episode_folders(folder: Path) -> list[Path]:
    """Return the folders of the episodes, sorted by name."""
    inside = sorted(p for p in folder.glob("*/") if not p.name.startswith("."))
    if not inside:
        raise InputError(
            f"{folder}: no folders in it; give the folder that holds the episodes"
        )
    return inside


def _audited(
    localizer: "Localizer",
    episode: Path,
    shots: Sequence[_Shot],
    agreement: tuple[float, float],
) -> Episode:
    differences = []
    reason = ""
    for name, image, camera, base_from_camera in shots:
        [item] = locate(localizer, [(name, image)], camera)
        if item.is_located:
            in_stated = base_from_camera.inverse() @ item.pose
            differences.append(replace(item, pose=in_stated))
        else:
            reason = item.estimate.reason
    if not differences:
        return Episode(episode.name, "unknown", f"no image was located: {reason}")
    fused = fuse(differences)
    localizer.contents.metric_scene(fused.scene)
    millimetres, degrees = pose_distance_mm_deg(fused.pose, SE3.identity())
    wrong = millimetres > agreement[0] or degrees > agreement[1]
    reason = (
        f"stated pose is {millimetres:.1f} mm and {degrees:.2f} deg from the images"
    )
    return Episode(
        episode.name, "wrong" if wrong else "right", reason, millimetres, degrees
    )


def _shots(episode: Path, stated: SE3 | None, count: int) -> list[_Shot]:
    pose = stated
    for name in POSE_FILES:
        if (episode / name).is_file():
            pose = read_transform(episode / name)
            break
    shots: list[_Shot] = []
    if recognised(episode) is not None:
        scene = load_recording(episode)
        for frame in (*scene.train, *scene.test):
            base_from_camera = frame.base_from_camera or pose
            if base_from_camera is not None:
                shot = (frame.name, frame.image, frame.camera, base_from_camera)
                shots.append(shot)
    else:
        files = files_in(episode, glob="**/*")
        if files and pose is None:
            raise InputError(
                f"{episode}: states no camera pose; put a {' or '.join(POSE_FILES)} there, or give"
                " the pose of all episodes with `calibration`"
            )
        if pose is not None:
            shots = [(file.name, file, None, pose) for file in files]
    if not shots:
        raise InputError(f"{episode}: no images with a stated camera pose in it")
    chosen = np.unique(np.linspace(0, len(shots) - 1, count).round().astype(int))
    return [shots[i] for i in chosen]
