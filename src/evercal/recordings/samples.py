"""The sample rooms that come with the package: three rendered rooms, made by `evercal simulate`."""

from dataclasses import dataclass
from pathlib import Path

from evercal.recordings import Recording, load_recording

FOLDER = Path(__file__).parent / "sample_rooms"
"""One folder for each room."""
ROOMS = ("bedroom", "kitchen", "living")
"""Names of the rooms, in order of learning."""


@dataclass(frozen=True, eq=False)
class SampleRoom:
    """The recordings of one sample room."""

    scene: Recording
    """From a moving camera: frames to learn from and frames to test on."""
    fixed: Recording | None = None
    """From a camera that stands still while the arm moves; all frames are test frames."""
    bumped: Recording | None = None
    """Like `fixed`, after a bump moved the camera; all frames are test frames."""
    changed: Recording | None = None
    """From a moving camera after small objects moved and lamps switched; all are test frames."""


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
