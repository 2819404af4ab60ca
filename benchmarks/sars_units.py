"""Frames that SARS keeps of a camera path, by the unit of camera positions."""

from collections.abc import Iterator
from pathlib import Path

from benchmarks.rows import Row, save
from evercal.geometry import SE3
from evercal.mapping.selection import UNITS, SarsOptions, select_sars
from evercal.recordings.frame import stated_poses
from evercal.recordings.samples import sample_rooms
from rooms.paths import sweep_shots
from rooms.room import room
from rooms.suites import SUITES


def run(out: Path = Path("runs/sars-units.csv")) -> None:
    """Select frames with the paper's radius and no limit, on the paths of two suites.

    Args:
        out: File of the rows.
    """
    rows = []
    for name, poses in _paths():
        row: Row = {"room": name, "frames": len(poses)}
        for unit in UNITS:
            options = SarsOptions(unit=unit)
            place = poses.translation_m, poses.rotation_wxyz
            row[unit] = len(select_sars(*place, len(poses), options))
        rows.append(row)
    save(out, rows)


def _paths() -> Iterator[tuple[str, SE3]]:
    """Training poses of rooms of 91 frames, and of 700; none is rendered."""
    for sample in sample_rooms():
        yield f"{sample.scene.name}, sim-mini", stated_poses(sample.scene.train)
    suite = SUITES["sim-unseen"]
    for name, kind, seed in suite.rooms:
        shots = sweep_shots(room(kind, seed), suite.frames, 0)
        poses = [shot.base_from_camera for shot in shots if shot.split == "train"]
        yield f"{name}, sim-unseen", SE3.stack(poses)
