"""Calibrates a fixed camera from images alone, writes the file a robot stack reads, finds a bump.

Run it with `python examples/02_calibrate.py`; it takes about half a minute and needs no data of
your own.
"""

import sys
import tempfile
from pathlib import Path

import evercal
from evercal.calibration.export import export_calibration
from evercal.recordings.samples import FOLDER


def main(out: Path) -> None:
    """Learns the bedroom, calibrates the camera on the tripod, and looks at it after a bump."""
    store = out / "cell.evercal"
    evercal.learn(store, FOLDER / "bedroom")
    localizer = evercal.Localizer.open(store)

    tripod = FOLDER / "bedroom/calibration/fixed/images"
    calibration = evercal.calibrate(localizer, evercal.Images.read(sorted(tripod.iterdir())))
    calibration.write(out / "calibration.json")
    print(calibration.meaning)
    print(calibration.verdict)
    export_calibration(calibration, "easy_handeye2", out / "tripod.calib")

    later = FOLDER / "bedroom/calibration/bumped/images"
    images = evercal.Images.read(sorted(later.iterdir())[:5]).images
    shift, _ = evercal.check(localizer, images, calibration)
    print(f"moved: {shift.moved}, {shift.translation_mm:.1f} mm, {shift.rotation_deg:.2f} deg")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as folder:
            main(Path(folder))
