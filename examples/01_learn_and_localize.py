"""Map a room from posed images and locate another image in it.

    python examples/01_learn_and_localize.py [RECORDING]

Without an argument it uses a packaged room with 91 posed images.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import evercal
from evercal.geometry import pose_distance_mm_deg
from evercal.recordings.samples import FOLDER


def main(path: Path) -> None:
    """Learn a recording and locate one of its test images."""
    recording = evercal.load_recording(path)
    with tempfile.TemporaryDirectory() as folder:
        cell = evercal.Map.open(Path(folder) / "cell.evercal")
        report = cell.learn(recording)
        frame = recording.test[0]
        estimate = cell.localize(frame.read_image())
    print(
        f"mapped {report.scene}: {report.frames_kept} keyframes, {report.landmarks} landmarks,"
        f" {report.seconds:.0f} s"
    )
    if estimate.uncertain_pose is None:
        print(f"no pose: {estimate.reason}")
        return
    np.set_printoptions(precision=4, suppress=True)
    print(f"scene: {estimate.scene}")
    print(f"base_from_camera, metres:\n{estimate.uncertain_pose.pose.matrix()}")
    deviation = np.sqrt(np.diag(estimate.uncertain_pose.covariance))
    print(
        f"standard deviation: {1000 * deviation[:3]} mm, {np.rad2deg(deviation[3:])} deg"
    )
    if frame.base_from_camera is not None:
        mm, deg = pose_distance_mm_deg(
            estimate.uncertain_pose.pose, frame.base_from_camera
        )
        print(f"error: {mm:.2f} mm, {deg:.3f} deg")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER / "bedroom")
