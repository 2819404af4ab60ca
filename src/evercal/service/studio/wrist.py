"""Learning the recording: the scene of the map, and the mount of the camera."""

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.learning.scene import LearnReport
from evercal.map import Map
from evercal.service.studio.folders import Folders
from evercal.storage import write_json

OnStep = Callable[[str, float, float], Any]


@dataclass(frozen=True)
class LearnedSamples:
    """What was learned last."""

    scene: str
    """Its name in the map; the studio replaces no other scene."""
    samples: tuple[str, ...]
    """Names of the samples."""

    def write(self, path: Path) -> None:
        """Write the file that a restarted studio reads."""
        write_json(path, {"scene": self.scene, "samples": list(self.samples)})


def read_learned(path: Path) -> LearnedSamples | None:
    """What an earlier session learned; None if nothing.

    Raises:
        InputError: The file is broken.
    """
    if not path.is_file():
        return None
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return LearnedSamples(str(data["scene"]), tuple(map(str, data["samples"])))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: is broken ({error}); remove it and learn again") from None


def free_name(name: str, taken: Sequence[str]) -> str:
    """A name that no scene has: `name`, or `name-2` and so on."""
    number, free = 2, name
    while free in taken:
        free, number = f"{name}-{number}", number + 1
    return free


def learned_again(cell: Map, folders: Folders, name: str, on_step: OnStep) -> LearnReport:
    """Learn the recording in a map of its own, then exchange the scene in one step."""
    from torch import nn

    old = cell.localizer.contents
    assert isinstance(old.encoder, nn.Module), "stored with the map"
    with tempfile.TemporaryDirectory(prefix=".learning-", dir=folders.out) as scratch:
        fresh = Map.open(Path(scratch) / "map", device=old.device.type, encoder=old.encoder)
        report = fresh.learn(folders.wrist, name=name, on_progress=on_step)
        cell.merge(fresh.path, on_clash="replace")
    return report


def learn_mount(
    cell: Map, folders: Folders, before: LearnedSamples | None, on_step: OnStep
) -> tuple[Calibration, str]:
    """Learn the recording, write the calibration of the mount, return it and the scene's name.

    The scene that the studio learned before is replaced once the new one is in the map.

    Raises:
        InputError: The recording cannot be used; the map is unchanged.
    """
    if before is not None and before.scene in cell.scenes:
        name = before.scene
        report = learned_again(cell, folders, name, on_step)
    else:
        name = free_name(folders.wrist.name, cell.scenes)
        # Written first: after a crash, the scene in the map is the studio's own.
        LearnedSamples(name, ()).write(folders.settings)
        try:
            report = cell.learn(folders.wrist, name=name, on_progress=on_step)
        except InputError:
            folders.settings.unlink()
            raise
    if report.hand_eye is None:
        raise InputError(f"{folders.wrist}: states camera poses, so there is no mount to estimate")
    scenes = cell.localizer.contents.scenes
    camera = next(scene.adjusted_camera for scene in scenes if scene.name == name)
    calibration = report.hand_eye.calibration(camera, name, report.train_frames)
    calibration.write(folders.calibration("wrist"))
    return calibration, name
