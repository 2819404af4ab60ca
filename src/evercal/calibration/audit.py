"""Which recorded episodes state a camera pose that their images disagree with."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import read_transform
from evercal.calibration.located import Located, deviations, fuse, length_mm_deg, locate
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings import load_recording, read_image
from evercal.recordings.images import IMAGE_ENDINGS

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer

POSE_FILES = ("calibration.json", "base_from_camera.txt")
"""Files of an episode's folder that state the pose of its camera."""


@dataclass(frozen=True)
class AuditOptions:
    """When an episode disagrees."""

    images: int = 5
    """Images of an episode that are looked at, spread over it."""
    most_mm: float = 5.0
    """Largest difference of position that is still right, millimetres."""
    most_deg: float = 0.5
    """Largest difference of rotation that is still right, degrees."""


@dataclass(frozen=True)
class Episode:
    """What was found about one episode."""

    name: str
    """Of its folder."""
    verdict: Literal["right", "wrong", "unknown"]
    """Whether its stated camera pose fits its images; unknown where they could not be located."""
    reason: str
    """One sentence."""
    translation_mm: float | None = None
    """Between the stated pose and the one found."""
    rotation_deg: float | None = None
    """The same for the rotation."""


def audit(
    localizer: "Localizer",
    folder: Path,
    stated: SE3 | None = None,
    options: AuditOptions | None = None,
    on_episode: Callable[[], object] = lambda: None,
) -> list[Episode]:
    """Compares stated camera poses with images, episode by episode.

    Args:
        localizer: of a store that knows the scene.
        folder: its folders are the episodes: recorded scenes with camera poses, or images beside a
            `calibration.json` or a 4x4 matrix `base_from_camera.txt`.
        stated: base_from_camera of all episodes that state none themselves.
        options: when an episode disagrees.
        on_episode: called after each.

    Raises:
        InputError: no folder in it, or an episode that states no pose and none was given.
    """
    options = options or AuditOptions()
    episodes = episode_folders(folder)
    audited = []
    for episode in episodes:
        audited.append(_audited(localizer, episode, stated, options))
        on_episode()
    return audited


def episode_folders(folder: Path) -> list[Path]:
    """The folders of the episodes, in order of name.

    Raises:
        InputError: not a folder, or none in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the one that holds the episodes")
    inside = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    if not inside:
        raise InputError(f"{folder}: no folders in it; every episode is one folder")
    return inside


@dataclass(frozen=True, eq=False)
class _Shot:
    """An image with the pose that is stated for it."""

    name: str
    read: Callable[[], NDArray[np.uint8]]
    camera: Camera | None
    base_from_camera: SE3


def _audited(
    localizer: "Localizer", episode: Path, stated: SE3 | None, options: AuditOptions
) -> Episode:
    shots = _shots(episode, stated)
    chosen = np.unique(np.linspace(0, len(shots) - 1, options.images).round().astype(int))
    differences, reason = [], ""
    for shot in (shots[i] for i in chosen):
        [item] = locate(
            localizer, [(shot.name, shot.read())], _camera_argument(localizer, shot.camera)
        )
        if item.is_located:
            in_stated = shot.base_from_camera.inverse() @ item.pose
            differences.append(Located(shot.name, item.estimate, in_stated, item.covariance))
        else:
            reason = item.estimate.reason
    if not differences:
        return Episode(episode.name, "unknown", f"no image was located: {reason}")
    off = deviations(SE3.stack([fuse(differences).pose]), SE3.identity())[0]
    millimetres, degrees = length_mm_deg(off)
    wrong = millimetres > options.most_mm or degrees > options.most_deg
    told = f"stated pose is {millimetres:.1f} mm and {degrees:.2f} deg from where it was found"
    return Episode(episode.name, "wrong" if wrong else "right", told, millimetres, degrees)


def _camera_argument(localizer: "Localizer", stated: Camera | None) -> Camera | None:
    return None if stated is None else localizer.camera_for(stated)


def _shots(episode: Path, stated: SE3 | None) -> list[_Shot]:
    """The images of an episode, in order."""
    pose_file = next((episode / name for name in POSE_FILES if (episode / name).is_file()), None)
    pose = stated if pose_file is None else read_transform(pose_file)
    try:
        scene = load_recording(episode)
    except InputError:
        files = sorted(p for p in episode.rglob("*") if p.suffix.lower() in IMAGE_ENDINGS)
        if files and pose is None:
            raise InputError(
                f"{episode}: states no camera pose; put a {' or '.join(POSE_FILES)} there, or give"
                " the pose of all episodes with --calibration"
            ) from None
        shots = [
            _Shot(path.name, partial(read_image, path), None, pose)
            for path in files
            if pose is not None
        ]
    else:
        shots = [
            _Shot(frame.name, frame.read_image, frame.camera, frame.base_from_camera)
            for frame in (*scene.train, *scene.test)
            if frame.base_from_camera is not None
        ]
    if not shots:
        raise InputError(f"{episode}: no images with a stated camera pose in it")
    return shots
