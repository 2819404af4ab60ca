"""A camera and an arm of a ROS 2 graph, for 09_ros2.py; with your own graph, leave it out.

python examples/ros2_cell.py arm RECORDING        # /tf: visits the poses of a recording
python examples/ros2_cell.py camera RECORDING     # /camera: shows its images where the arm is
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from evercal.geometry import SE3, UncertainPose, pose_distance
from evercal.live.ros2.graph import Graph, header, make
from evercal.live.ros2.publishing import PosePublisher
from evercal.live.sources import open_robot
from evercal.recordings import load_recording
from evercal.simulation.cell_recording import record_cell

MOVE_S = 0.3
DWELL_S = 1.5


@contextmanager
def virtual_cell(folder: Path = Path("virtual")) -> Iterator[None]:
    """Record a virtual cell; an arm and a camera in it run as two processes."""
    list(record_cell(folder))
    command = [sys.executable, __file__]
    run = [[*command, what, str(folder / "wrist")] for what in ("arm", "camera")]
    pipe = subprocess.PIPE
    with (
        subprocess.Popen(run[0]) as first,
        subprocess.Popen(run[1], stdout=pipe) as second,
    ):
        try:
            second.stdout.readline()  # it shows images
            yield
        finally:
            first.kill()
            second.kill()


def arm(poses: SE3) -> None:
    """Go from pose to pose, on a straight line, and stand at each."""
    publisher = PosePublisher("base_link", "tool0", static=False)
    begun = time.time()
    while True:
        now = time.time()
        number, seconds = divmod(now - begun, DWELL_S)
        last = poses[(int(number) - 1) % len(poses)]
        to_next = (last.inverse() @ poses[int(number) % len(poses)]).log()
        pose = last @ SE3.exp(min(seconds / MOVE_S, 1.0) * to_next)
        publisher.publish(UncertainPose.exact(pose), now)
        time.sleep(0.02)


def camera(recording) -> None:
    """Show the image of the pose nearest to the arm's."""
    frames = recording.train
    images = [frame.read_image() for frame in frames]
    poses = SE3.stack([frame.base_from_gripper for frame in frames])
    graph = Graph()
    show = graph.publisher("/camera/image_raw", "sensor_msgs/msg/Image", False)
    inform = graph.publisher("/camera/camera_info", "sensor_msgs/msg/CameraInfo", False)
    roi = make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    lens = frames[0].camera
    coefficients = np.array([*lens.distortion, 0, 0, 0, 0, 0][:5], float)
    k = lens.matrix()
    words = ("plumb_bob", coefficients, k.ravel(), np.eye(3).ravel())
    words += (np.eye(3, 4).ravel(), 0, 0, roi)
    size = (lens.height, lens.width)
    robot = open_robot("ros2:")
    robot.base_from_gripper()
    print("ready", flush=True)
    while True:
        pose = robot.base_from_gripper()
        image = images[int(np.argmin(pose_distance(pose, poses)[0]))]
        own = header("wrist_optical", time.time())
        row = 3 * lens.width
        bytes_of = image.ravel()
        show(make("sensor_msgs/msg/Image", own, *size, "rgb8", 0, row, bytes_of))
        inform(make("sensor_msgs/msg/CameraInfo", own, *size, *words))
        time.sleep(0.1)


if __name__ == "__main__":
    what, path = sys.argv[1:]
    read = load_recording(path)
    if what == "camera":
        camera(read)
    else:
        arm(SE3.stack([frame.base_from_gripper for frame in read.train]))
