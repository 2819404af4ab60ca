"""`evercal eye-to-hand`."""

import tempfile
from dataclasses import field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.calibrate import joint_lines, show_calibration
from evercal.cli.console import require_writable
from evercal.progress import Bars


@frozen
class EyeToHand(args.Verb):
    """Calibrate a fixed camera by any textured thing in the gripper; no board, no map.

    The recording has images of the fixed camera and the gripper's pose at each. The arm holds a
    box, a book or a printed picture, and turns it by 20 degrees and more about two axes.

    Example: evercal eye-to-hand recording/ --camera camera.json --out tripod.json
    """

    writes = ("out", "map")
    recording: Annotated[Positional[Path], args.shown("RECORDING")]
    """Folder of images with base_from_gripper.csv or joints.csv, or a bag."""
    out: args.OutFile = Path("calibration.json")
    """Output file."""
    map: args.File = None
    """Keep the thing as a scene of this map: `check` and `calibrate` with --robot-poses use it."""
    name: args.Name = None
    """Name of that scene. Default: the recording's own name."""
    reading: args.HowRead = field(default_factory=args.Reading)
    which: args.WhichArm = field(default_factory=args.ArmGiven)
    at: args.At = None

    def run(self) -> int:
        require_writable(self.out, "--out")
        point = args.Point.parse(self.at)
        from evercal.map import Map

        recording = self.reading.recording(self.recording, self.name)
        with tempfile.TemporaryDirectory() as folder:
            cell = Map.open(self.map or Path(folder) / "thing")
            start = f"{recording.name}: {len(recording.train)} images"
            with Bars(self.log, start) as bars:
                calibration = cell.eye_to_hand(
                    recording, errors=self.which.errors(), on_progress=bars.step
                )
        calibration.write(self.out)
        lines = joint_lines(calibration.joints, self.out)
        return show_calibration(self, calibration, self.out, point, lines)
