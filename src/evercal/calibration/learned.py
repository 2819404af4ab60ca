"""The calibration that a map keeps of a scene that was learned from gripper poses."""

import os
from dataclasses import replace
from pathlib import Path

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.errors import InputError
from evercal.storage.provenance import Made
from evercal.storage.stages import is_store
from evercal.storage.text_files import read_json
from evercal.typing import JsonObject, PathLike


def calibration_at(path: PathLike) -> Calibration:
    """Read a calibration from its file, a map (`MAP`), or one of its scenes (`MAP:SCENE`).

    A camera of a rig is `RIG.json:CAMERA`.
    """
    root, _, scene = os.fspath(path).rpartition(":")
    if is_store(Path(path)):
        return learned_calibration(Path(path))
    if root and is_store(Path(root)):
        return learned_calibration(Path(root), scene)
    if root and Path(root).is_file():
        cameras = read_json(Path(root), "file of several cameras").get("cameras", {})
        if scene not in cameras:
            known = ", ".join(cameras) or "no cameras"
            raise InputError(f"{root}: has {known}, and not {scene!r}")
        return Calibration.from_dict(cameras[scene])
    return read_calibration(path)


def learned_calibration(root: Path, scene: str | None = None) -> Calibration:
    """Return the calibration of a scene, by default the only one with gripper poses."""
    from evercal.mapping.store import stored_scenes

    stored = stored_scenes(root)
    wrist = [name for name, report in stored.items() if report.get("hand_eye")]
    if scene is not None and scene not in stored:
        raise InputError(f"scene {scene!r}: map {root} has only {', '.join(stored)}")
    if scene is None and len(wrist) > 1:
        raise InputError(
            f"map {root}: {', '.join(wrist)} each have a calibration; name one, such as"
            f" {root}:{wrist[0]}"
        )
    name = scene or next(iter(wrist), None)
    if name not in wrist:
        place = root if name is None else f"{root}:{name}"
        raise InputError(
            f"{place}: was not learned from gripper poses, so it has no gripper_from_camera; run"
            " 'evercal calibrate' and give its file"
        )
    calibration = calibration_of(stored[name])
    # The scene may have another name now.
    return replace(calibration, source={**calibration.source, "scene": name})


def calibration_of(report: JsonObject) -> Calibration:
    """The calibration in the report of a scene, with the record of what made it."""
    record = report.get("calibration", report["hand_eye"])
    if "format" not in record:
        raise InputError("it was learned before version 0.2; learn it again")
    calibration = Calibration.from_dict(record)
    made = calibration.made or Made.from_dict(report.get("made"))
    return replace(calibration, made=made)
