"""Cameras and robots by the texts that name them on the command line."""

from pathlib import Path

from evercal.live.camera import StreamCamera
from evercal.live.robot import PoseFileRobot, Robot
from evercal.robot.frame_names import UNKNOWN, FrameNames


def open_camera(
    source: str, rate: float = 15.0, timeout_s: float | None = 5.0
) -> StreamCamera:
    """The camera of a source, see `StreamCamera`, or of a topic such as `ros2:/image_raw`."""
    if source.startswith("ros2:"):
        from evercal.live.ros2.camera import Ros2Camera

        return Ros2Camera(source, timeout_s)
    return StreamCamera(source, rate, timeout_s)


def open_robot(
    source: Path | str,
    frames: FrameNames = UNKNOWN,
    convention: str | None = None,
    most_age_s: float | None = None,
) -> Robot:
    """The robot of a pose file, see `PoseFileRobot`, or for `ros2:` that of tf."""
    if str(source) == "ros2:":
        from evercal.live.ros2.robot import Ros2Robot

        return Ros2Robot(frames)
    return PoseFileRobot(source, convention, most_age_s, frames)
