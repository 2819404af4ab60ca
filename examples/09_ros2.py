"""Record from a running ROS 2 graph, calibrate, and publish the transform. ROS is not needed.

    python examples/09_ros2.py [TOPIC]

TOPIC has the images, such as /camera/image_raw. By default ros2_cell.py publishes a virtual camera
and arm, in two processes. It needs the extra `ros2`.
"""

import sys
import time
from contextlib import nullcontext

from ros2_cell import virtual_cell

import evercal
from evercal import cli
from evercal.live.ros2.publishing import PosePublisher


def main(topic: str | None) -> None:
    """Write ros2.json and publish it on /tf_static."""
    with nullcontext() if topic else virtual_cell():
        source = f"ros2:{topic or '/camera/image_raw'}"
        cli.main(["record", source, "ros2", "--most", "25"])
    cell = evercal.Map.open("ros2.evercal")
    cell.learn("ros2")
    wrist = cell.calibration()
    print(f"{wrist.meaning}; {wrist.verdict}")
    wrist.write("ros2.json")
    publisher = PosePublisher(wrist.parent_frame, wrist.child_frame, static=True)
    publisher.publish(wrist.uncertain_pose, time.time())
    print(f"on {' and '.join(publisher.topics)} until this program ends")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
