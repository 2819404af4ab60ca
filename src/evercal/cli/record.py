"""`evercal record`."""

import sys
from dataclasses import replace
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import say
from evercal.errors import InputError


@frozen
class Record(args.Verb):
    """Record a camera on the gripper while the arm visits poses.

    A sample is taken wherever the arm stands still at a new pose, until Ctrl-C; OUT is continued.
    Intrinsics and names of frames come from ROS 2 where the source is a topic of it.

    Example: evercal record ros2:/camera/image_raw recording/
    """

    source: Annotated[Positional[str], arg(metavar="SOURCE")]
    """Topic of ROS 2 (ros2:/camera/image_raw), number (0) or device of a camera, or address."""
    out: args.NewFolder
    """Folder of the recording."""
    poses: args.Address = None
    """Gripper poses: `ros2:` (tf), or a table or JSON lines that your robot's program appends to.
    Default: ros2: if the source is a topic."""
    pose_convention: args.Name = None
    """Convention of a file of poses if its header does not state it: ur, kuka, fanuc, ..."""
    base_frame: args.Frame = None
    """The robot's base in tf. Default: the one with a usual name."""
    gripper_frame: args.Frame = None
    """The gripper in tf. Default: the one with a usual name."""
    intrinsics: args.File = None
    """Intrinsics. Default: the camera_info beside the images."""
    key: bool = False
    """Take a sample at every press of Enter instead; end with Ctrl-D."""
    most: args.Count = None
    """Stop when OUT holds so many samples."""

    def run(self) -> int:
        from evercal.live.coverage import Sample, coverage
        from evercal.live.recorder import WristRecorder
        from evercal.live.sampling import MovedError, sample, wait_at_new_pose
        from evercal.live.sources import open_camera, open_robot
        from evercal.robot.frame_names import FrameNames

        poses = self.poses
        if poses is None and self.source.startswith("ros2:"):
            poses = "ros2:"
        if poses is None:
            raise InputError(
                "no --poses given: a file of gripper poses, or ros2: for those of tf"
            )
        names = FrameNames(self.base_frame or "", self.gripper_frame or "")
        robot = open_robot(poses, names, self.pose_convention)
        with open_camera(self.source) as camera:
            _, image = camera.read()
            size = (image.shape[1], image.shape[0])
            stated = args.stated_camera(self.intrinsics, size)
            intrinsics = stated or camera.intrinsics()
            if intrinsics is None:
                raise InputError(
                    f"no --intrinsics FILE given, and {self.source} states none"
                )
            robot.base_from_gripper()
            names = replace(getattr(robot, "frames", names), camera=camera.frame_id)
            recorder = WristRecorder(self.out, intrinsics, names)
            samples = [*map(Sample.of, recorder.frames)]
            try:
                while self.most is None or len(samples) < self.most:
                    if not self.key:
                        known = [one.base_from_gripper for one in samples]
                        wait_at_new_pose(robot, known)
                    elif not sys.stdin.readline():
                        break
                    try:
                        frame = recorder.add(*sample(camera.read, robot))
                    except MovedError as error:
                        say(f"note: {error}", sys.stderr)
                        continue
                    samples.append(Sample.of(frame))
                    if not self.json:
                        say(f"{frame.name}: {coverage(samples).verdict}")
            except KeyboardInterrupt:
                pass
        covered = coverage(samples)
        record = {"recording": str(self.out), "verdict": covered.verdict}
        line = f"wrote {self.out}: {covered.verdict}"
        self.answer(record, line, then=("learn", "MAP", self.out))
        return 0 if covered.ready else 1
