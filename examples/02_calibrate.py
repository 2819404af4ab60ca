"""Calibrate a camera on the gripper and a fixed camera from images alone, then detect a bump.

    python examples/02_calibrate.py [FOLDER]

The packaged robot cell has a wrist recording with gripper poses, images of a tripod camera, and one
image after the tripod was bumped by 5 mm. It takes half a minute.
"""

import sys
import tempfile
from pathlib import Path

import evercal
from evercal.recordings.samples import CELL


def main(out: Path) -> None:
    """Write the map, both calibrations and an export to a folder."""
    cell = evercal.Map.open(out / "cell.evercal")
    report = cell.learn(CELL / "wrist")
    assert report.hand_eye is not None, "the recording states gripper poses"
    gripper_from_camera = report.hand_eye.parent_from_camera
    print(f"gripper_from_camera: {1000 * gripper_from_camera.pose.translation_m} mm")
    print(f"standard deviation: {gripper_from_camera.sigma_mm:.2f} mm per axis")

    names = evercal.FrameNames("base_link", camera="tripod_optical")
    tripod = cell.calibrate(CELL / "tripod", frames=names)
    tripod.write(out / "tripod.json")
    tripod.export("urdf", out / "tripod.urdf")
    print(tripod.meaning)
    print(tripod.verdict)

    shift = cell.check(CELL / "bumped.jpg", tripod)
    print(
        f"moved: {shift.moved}, {shift.translation_mm:.1f} mm, {shift.rotation_deg:.2f} deg"
    )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as folder:
            main(Path(folder))
