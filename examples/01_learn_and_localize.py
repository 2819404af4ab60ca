"""Learns a room from posed images and says where the camera of another image was.

    python examples/01_learn_and_localize.py

The room comes with the package: 91 images with their poses to learn from, others to be judged on.
Give the folder of a recording of your own to use that instead.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import evercal
from evercal.geometry import pose_distance
from evercal.recordings.samples import FOLDER


def main(recording: Path) -> None:
    """Learns a recording into a store, and locates one of its test images."""
    scene = evercal.load_recording(recording)
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "robot.evercal"
        report = evercal.learn(store, scene)
        print(
            f"{report.scene}: {report.frames_kept} keyframes with {report.landmarks} landmarks,"
            f" learned in {report.seconds:.0f} s"
        )
        localizer = evercal.Localizer.open(store)

    frame = scene.test[0]
    estimate = localizer.localize(frame.read_image(), frame.camera)
    if estimate.base_from_camera is None or estimate.covariance is None:
        print(f"no pose: {estimate.reason}")
        return
    np.set_printoptions(precision=4, suppress=True)
    print(f"the image shows {estimate.scene}; base_from_camera is, in metres,")
    print(estimate.base_from_camera.matrix())
    deviation = np.sqrt(np.diag(estimate.covariance))
    print(f"uncertainty, one standard deviation: {1000 * deviation[:3]} mm")
    print(f"                                     {np.rad2deg(deviation[3:])} deg")
    if frame.base_from_camera is not None:
        metres, radians = pose_distance(estimate.base_from_camera, frame.base_from_camera)
        print(f"error: {1000 * metres:.2f} mm, {np.rad2deg(radians):.3f} deg")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER / "bedroom")
