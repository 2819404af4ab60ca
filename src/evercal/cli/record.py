"""`evercal record`."""

import sys
from contextlib import suppress
from dataclasses import replace
from itertools import islice
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
    named: args.HowNamed = args.Named()
    intrinsics: args.File = None
    """Intrinsics. Default: the camera_info beside the images."""
    key: bool = False
    """Take a sample at every press of Enter, once the arm stands; end with Ctrl-D."""
    most: args.Count = None
    """Stop when OUT holds so many samples."""

    def run(self) -> int:
        from evercal.live.coverage import Sample, coverage
        from evercal.live.recorder import WristRecorder
        from evercal.live.sampling import samples
        from evercal.live.sources import open_camera, open_robot

        poses = self.poses
        if poses is None and self.source.startswith("ros2:"):
            poses = "ros2:"
        if poses is None:
            raise InputError(
                "no --poses given: a file of gripper poses, or ros2: for those of tf"
            )
        names = self.named.names()
        robot = open_robot(poses, names, self.pose_convention)
        with open_camera(self.source) as camera:
            _, image = camera.read()
            size = (image.shape[1], image.shape[0])
            stated = args.stated_camera(self.intrinsics, size)
            intrinsics = stated or camera.intrinsics()
            if not intrinsics:
                raise InputError(
                    f"no --intrinsics FILE given, and {self.source} states none"
                )
            robot.base_from_gripper()
            names = getattr(robot, "frames", names)
            if camera.frame_id:
                names = replace(names, camera=camera.frame_id)
            recorder = WristRecorder(self.out, intrinsics, names)
            taken = [*map(Sample.of, recorder.frames)]
            known = [one.base_from_gripper for one in taken]
            left = None if self.most is None else max(0, self.most - len(taken))
            asked = sys.stdin if self.key else None
            arriving = samples(camera.read, robot, known, asked)
            with suppress(KeyboardInterrupt):
                for image, pose in islice(arriving, left):
                    taken.append(Sample.of(recorder.add(image, pose)))
                    if not self.json:
                        say(f"{taken[-1].name}: {coverage(taken).verdict}")
        covered = coverage(taken)
        record = {"recording": str(self.out), "verdict": covered.verdict}
        line = f"wrote {self.out}: {covered.verdict}"
        then = ("learn", "MAP", self.out)
        if not covered.ready:
            then = ("record", self.source, self.out)
        self.answer(record, line, then=then)
        return 0 if covered.ready else 1
