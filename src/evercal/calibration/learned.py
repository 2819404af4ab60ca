"""The calibration that a map keeps of a scene that was learned from gripper poses."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from evercal.calibration.calibration import (
    FORMAT,
    VERSION,
    Calibration,
    read_calibration,
)
from evercal.errors import InputError
from evercal.robot.mount import mount_named
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
    """Return the calibration of a scene, by default the only one with gripper poses."""
    from evercal.mapping.store import stored_scenes

    stored = {}
    wrist = []
    for name, camera, report in stored_scenes(root):
        stored[name] = (camera, report)
        if report.get("hand_eye"):
            wrist.append(name)
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
    camera, report = stored[name]
    if "calibration" in report:
        calibration = Calibration.from_dict(report["calibration"])
    else:
        calibration = replace(_of_version_0_1(report), camera=camera)
    # The scene may have another name now.
    source = {**calibration.source, "scene": name}
    return replace(calibration, source=source)


def _of_version_0_1(report: Mapping[str, Any]) -> Calibration:
    """The calibration of a report that states its values, written before version 0.2."""
    from evercal.calibration.from_map.hand_eye import verdict_of

    values = report["hand_eye"]
    mount = mount_named(values.get("mount", "eye_in_hand"))
    checks = {}
    if values.get("image_scatter"):
        checks["images_used"] = values["images_located"]
        checks["image_scatter"] = values["image_scatter"]
    if values.get("joints_move_mm"):
        checks["joints_move_mm"] = values["joints_move_mm"]
    record = {
        **values,
        "format": FORMAT,
        "version": VERSION,
        "mount": mount.name,
        "parent_frame": mount.parent,
        "child_frame": "camera",
        "checks": checks,
        "source": {
            "command": "learn" if mount.moves else "eye-to-hand",
            "scene": report.get("scene"),
            "frames": int(report["train_frames"]),
            "map": values.get("map", ""),
        },
    }
    calibration = Calibration.from_dict(record)
    warnings = values.get("warnings", ())
    sentences = verdict_of(calibration, warnings, values.get("advice", ""))
    return replace(calibration, verdict=sentences)
