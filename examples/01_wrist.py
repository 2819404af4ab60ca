"""A camera on the gripper, from images and gripper poses: `gripper_from_camera`, and a map.

    python examples/01_wrist.py [RECORDING]

RECORDING is a folder of images with base_from_gripper.csv and camera.json. The default is packaged.
"""

import sys
from pathlib import Path

import evercal
from evercal.recordings.samples import CELL


def main(recording: Path) -> None:
    """Map the cell and write wrist.json."""
    cell = evercal.Map.open("cell.evercal")
    report = cell.learn(recording)
    print(f"{report.train_frames} images, {report.landmarks} landmarks")

    wrist = cell.calibration()
    print(wrist.meaning)
    print(f"translation {wrist.parent_from_child.translation_m} m")
    print(f"sigma {wrist.sigma_mm:.2f} mm, {wrist.sigma_deg:.3f} deg per axis")
    print(wrist.verdict)
    wrist.write("wrist.json")
    wrist.export("urdf", "wrist.urdf", parent="tool0", child="wrist_optical")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else CELL / "wrist")
