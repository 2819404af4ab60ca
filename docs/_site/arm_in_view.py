"""Draw the picture of an arm in view: python docs/_site/arm_in_view.py RECORDING CALIBRATION.

RECORDING is a rendered room with joint values and a URDF, CALIBRATION is made of it by
`evercal arm-in-view`.
"""

import sys
from pathlib import Path

import numpy as np

from evercal.calibration.calibration import read_calibration
from evercal.recordings import ReadOptions, load_recording, write_image
from evercal.recordings.formats.wrist import urdf_beside
from evercal.reports.arm_pictures import arm_pictures
from evercal.reports.overlay import resized
from evercal.robot.robot_model import RobotModel

OUT = Path(__file__).parents[1] / "arm_in_view.jpg"


def main(recording: Path, calibration: Path) -> None:
    """Draw the outline of the arm into three images, side by side."""
    model = RobotModel(urdf_beside(recording))
    frames = load_recording(recording, None, None, ReadOptions(whole_robot=True))
    drawn = arm_pictures(read_calibration(calibration), frames, model)
    pictures = [resized(part.image, 420) for part in drawn.images.values()]
    write_image(OUT, np.concatenate(pictures[:3], axis=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
