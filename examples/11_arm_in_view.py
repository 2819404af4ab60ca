"""A fixed camera by the arm in its images: no board, no map, nothing in the gripper.

    python examples/11_arm_in_view.py RECORDING

RECORDING has images of the fixed camera, the joint values at each in joints.csv, camera.json, and
the URDF of the robot with its meshes (extra `urdf`).
"""

import sys
from pathlib import Path

from evercal import ReadOptions, load_recording
from evercal.calibration.arm_in_view.solve import calibrate_arm_in_view
from evercal.robot.robot_model import RobotModel


def main(folder: Path) -> None:
    """Write camera.json beside the recording."""
    recording = load_recording(folder, options=ReadOptions(whole_robot=True))
    [urdf] = folder.glob("*.urdf")
    camera = calibrate_arm_in_view(recording, RobotModel(urdf))
    print(camera.meaning)
    print(camera.parent_from_child.matrix())
    for joint in camera.joints:
        print(joint.name, joint.open or f"{joint.offset:+.4f}")
    print(camera.verdict)
    camera.write(f"{folder}.json")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
