"""The calibration of the camera on the gripper that a map keeps in the report of its scene."""

import os
from pathlib import Path

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.errors import InputError
from evercal.storage.stages import is_store
from evercal.typing import PathLike


def calibration_at(path: PathLike) -> Calibration:
    """Read a calibration from its file, a map (`MAP`) or one of its scenes (`MAP:SCENE`)."""
    root, _, scene = os.fspath(path).rpartition(":")
    if is_store(Path(path)):
        return learned_calibration(Path(path))
    if root and is_store(Path(root)):
        return learned_calibration(Path(root), scene)
    return read_calibration(path)


def learned_calibration(root: Path, scene: str | None = None) -> Calibration:
    """Return the `gripper_from_camera` of a scene, by default the only one with gripper poses."""
    from evercal.calibration.hand_eye import HandEyeReport
    from evercal.mapping.store import stored_scenes

    stored = {name: (camera, report) for name, camera, report in stored_scenes(root)}
    if scene is not None and scene not in stored:
        raise InputError(f"scene {scene!r}: map {root} has only {', '.join(stored)}")
    wrist = [name for name, (_, report) in stored.items() if report.get("hand_eye")]
    if scene is None and len(wrist) > 1:
        raise InputError(
            f"map {root}: {', '.join(wrist)} each have a calibration; name one, such as"
            f" {root}:{wrist[0]}"
        )
    name = scene or next(iter(wrist), None)
    if name not in wrist:
        raise InputError(
            f"{root if name is None else f'{root}:{name}'}: was not learned from gripper poses, so"
            " it has no gripper_from_camera; run 'evercal calibrate' and give its file"
        )
    camera, report = stored[name]
    hand_eye = HandEyeReport.from_dict(report["hand_eye"])
    return hand_eye.calibration(camera, name, int(report["train_frames"]))
