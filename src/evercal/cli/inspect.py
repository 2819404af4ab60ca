"""`evercal inspect`."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next
from evercal.cli.reading import Reading


@dataclass(frozen=True)
class Inspect:
    """Check a recording before it is learned: frames, cameras, motion, and likely mistakes.

    Example: evercal inspect wrist_recording/
    """

    scene: Annotated[Positional[Path], arg(metavar="RECORDING")]
    """Folder of the recording, or file of a bag."""
    reading: Annotated[Reading, arg(name="")] = field(default_factory=Reading)
    """How the recording is read."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Read the recording and some of its images."""
        from evercal.recordings.inspection import inspect_recording

        found = inspect_recording(self.reading.recording(self.scene))
        if self.json:
            print_json(asdict(found))
            return 0
        extent = " x ".join(f"{side:.2f}" for side in found.extent_m)
        whose = {"camera": "", "gripper": " with the gripper's pose"}.get(found.poses, "")
        print(f"{found.name}: {found.train} training and {found.test} test frames{whose}")
        print(f"  without a pose  {found.untracked}")
        for lens in found.cameras:
            print(f"  camera          {lens}")
        mover = "gripper" if found.poses == "gripper" else "camera"
        print(f"  {mover} moved in {extent} m (training frames)")
        if found.step_median_m is not None and found.step_largest_m is not None:
            print(
                f"  frame to frame  {100 * found.step_median_m:.1f} cm"
                f" and {found.step_median_deg:.1f} deg (median),"
                f" {found.step_largest_m:.2f} m at most"
            )
        if found.near_training is not None:
            print(
                f"  near training   {found.near_training:.1f} % of the test frames lie within 5 cm"
                f" and 5 deg of a training frame"
            )
        for note in found.notes:
            print(f"note: {note}")
        for warning in found.warnings:
            print(f"warning: {warning}")
        print_next("evercal", "learn", "STORE", self.scene, *self.reading.words())
        return 0
