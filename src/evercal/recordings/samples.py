"""Sample recordings of three rendered rooms, made by `evercal simulate`."""

from dataclasses import dataclass
from pathlib import Path

from evercal.recordings import Recording, load_recording

FOLDER = Path(__file__).parent / "sample_rooms"
"""Folder with one folder for each room."""
ROOMS = ("bedroom", "kitchen", "living")
"""Names of the rooms, in order of learning."""


@dataclass(frozen=True, eq=False)
class SampleRoom:
    """The recordings of one sample room."""

    scene: Recording
    """From a moving camera: training and test frames."""
    fixed: Recording | None = None
    """From a fixed camera while the arm moves; test frames only."""
    bumped: Recording | None = None
    """Like `fixed`, after a bump moved the camera; test frames only."""
    changed: Recording | None = None
    """From a moving camera after small objects and lamps changed; test frames only."""


def sample_rooms() -> tuple[SampleRoom, ...]:
    """Load the sample rooms in the order of `ROOMS`."""
    return tuple(
        SampleRoom(
            load_recording(FOLDER / name),
            load_recording(FOLDER / name / "calibration" / "fixed"),
            load_recording(FOLDER / name / "calibration" / "bumped"),
            load_recording(FOLDER / name / "changed"),
        )
        for name in ROOMS
    )
