"""Sample recordings in the package: three rendered rooms and a robot cell with known answers."""

import shutil
from pathlib import Path

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.recordings.frame import Recording
from evercal.recordings.load import load_recording

FOLDER = Path(__file__).parent / "sample_rooms"
"""One folder for each room, rendered by `python -m rooms sim-mini`."""
ROOMS = ("bedroom", "kitchen", "living")
"""Names of the rooms, in order of learning."""
CELL = Path(__file__).parent / "sample_cell"
"""A robot cell: `wrist` (images and gripper poses), `tripod` (images of a fixed camera),
`bumped.jpg` (the fixed camera after a bump) and `truth.json` (true poses)."""


@frozen_arrays
class SampleRoom:
    """The recordings of one sample room."""

    scene: Recording
    """A moving camera: training and test frames."""
    fixed: Recording | None = None
    """A fixed camera while the arm moves: test frames."""
    bumped: Recording | None = None
    """The fixed camera after a bump: test frames."""
    changed: Recording | None = None
    """A moving camera after small objects moved and lamps switched: test frames."""


def sample_rooms() -> tuple[SampleRoom, ...]:
    """Load the sample rooms in the order of `ROOMS`."""
    rooms = []
    for name in ROOMS:
        parts = ("", "calibration/fixed", "calibration/bumped", "changed")
        recordings = (load_recording(FOLDER / name / part) for part in parts)
        rooms.append(SampleRoom(*recordings))
    return tuple(rooms)


def copy_samples(target: Path) -> None:
    """Copy `bedroom`, `kitchen`, `living` and `cell` to a new or empty folder."""
    if target.exists() and not target.is_dir():
        raise InputError(
            f"{target}: is a file; name a new folder for the sample recordings"
        )
    sources = {name: FOLDER / name for name in ROOMS}
    sources["cell"] = CELL
    try:
        if target.is_dir() and any(target.iterdir()):
            raise InputError(
                f"{target}: is not empty; name a new folder for the recordings"
            )
        for name, source in sources.items():
            # Installed packages can be read-only; copyfile leaves the copies writable.
            shutil.copytree(source, target / name, copy_function=shutil.copyfile)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error})") from None
