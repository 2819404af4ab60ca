"""`evercal studio`: joins cameras and robot, real or virtual, with the page."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.view import PageVerb
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.geometry import Camera
    from evercal.live.camera import StreamCamera
    from evercal.service.studio.devices import Devices

_REAL = (
    "camera",
    "intrinsics",
    "poses",
    "pose_convention",
    "most_age",
    "reachable",
    "gripper_from_camera",
    "fixed",
)
"""Options that the virtual cell refuses."""


@frozen
class Studio(PageVerb):
    """Calibrate wrist and fixed camera in the browser, step by step.

    Everything is written to --out as it is made; the same command continues there. A fixed camera
    alone, without --camera, is calibrated by a textured thing in the gripper. With --virtual, a
    virtual arm with two cameras stands in for yours.

    Example: evercal studio --camera 0 --intrinsics camera.json --poses poses.csv
    """

    map: Annotated[Positional[Path | None], args.shown("[MAP]")] = None
    """Folder of the map that learns the scene. Default: a new one in --out."""
    camera: args.Source = None
    """Camera on the gripper: number (0) or device, address (rtsp://...), topic of ROS 2
    (ros2:/camera/image_raw), video or folder."""
    intrinsics: args.File = None
    """Intrinsics of --camera. Default: those in --out, where it was begun before, or those of
    camera_info for a topic; without --camera, --fixed-intrinsics."""
    poses: args.File = None
    """Gripper poses: a table or JSON lines that your robot's program appends to, or `ros2:` for
    those of tf."""
    named: args.HowNamed = args.Named()
    pose_convention: args.Name = None
    """Convention of --poses if its header does not state it: ur, kuka, fanuc, ..."""
    most_age: Annotated[float | None, args.shown("S")] = None
    """Refuse the last pose of --poses if the file was written more seconds ago. Default: any age,
    for programs that write only when the arm has moved."""
    reachable: args.File = None
    """Gripper poses that the robot can reach, for the next best views. Default: near others."""
    gripper_from_camera: args.File = None
    """A rough gripper_from_camera for the drawing and the next views: 4x4 matrix or calibration."""
    fixed: args.Source = None
    """The fixed camera; sources as for --camera."""
    fixed_intrinsics: args.File = None
    """Intrinsics of --fixed. Default: those of camera_info for a topic, else those of the camera
    on the gripper."""
    virtual: bool = False
    """A virtual arm with a wrist camera and a tripod camera instead of yours."""
    seed: Annotated[int, arg(metavar="I")] = 0
    """Seed of the virtual cell."""
    out: args.OutFolder = Path("studio")
    """Folder of the recording, images, calibrations, reports and exports."""

    def run(self) -> int:
        self._refuse()
        self.prepare()
        from evercal.service.studio.page import StudioPage
        from evercal.service.studio.studio import Studio as Session

        devices = self._virtual() if self.virtual else self._real()
        page = StudioPage(Session(devices, self.out, self.map), self.host, self.port)
        try:
            url = page.server.url
            words = f"studio in {self.out}, where the same command continues"
            self.wait({"url": url}, words, f"  {url}")
        finally:
            page.close()
        return 0

    def _refuse(self) -> None:
        if self.virtual:
            for name in _REAL:
                if getattr(self, name) is not None:
                    raise InputError(
                        f"{args.option(name)}: the virtual cell has its own; omit it or --virtual"
                    )
        else:
            missing = ""
            if self.camera is None and self.fixed is None:
                missing = "--camera SOURCE"
            elif not self.poses:
                missing = "--poses FILE"
            if missing:
                raise InputError(
                    f"no {missing} given; give both, or --virtual to try it without"
                )
        if self.fixed_intrinsics and self.fixed is None:
            raise InputError("--fixed-intrinsics: is of --fixed, which is missing")

    def _virtual(self) -> "Devices":
        """Arm and cameras of the virtual cell, at the pace of a real one."""
        import numpy as np

        from evercal.service.studio.devices import Devices
        from evercal.simulation.panda_arm import joint_frames
        from evercal.simulation.virtual_cell import (
            CellOptions,
            VirtualCell,
            nominal_mount,
        )

        cell = VirtualCell(self.seed, CellOptions(realtime=True))
        return Devices(
            wrist_camera=cell.wrist_camera,
            intrinsics=cell.intrinsics,
            robot=cell.robot,
            fixed_camera=cell.tripod_camera,  # of the same make, so it has the same intrinsics
            reachable=cell.reachable_poses(200),
            holding=cell.holding_poses(200),
            hold=cell.hold,
            rough=nominal_mount(),
            settle_s=0.0,
            arm=lambda: joint_frames(np.array(cell.robot.joints_rad()))[:, :3, 3],
        )

    def _real(self) -> "Devices":
        """The cameras and the pose file that were named."""
        from evercal.live.sources import open_camera, open_robot
        from evercal.recordings import read_robot_poses
        from evercal.recordings.streams import is_live
        from evercal.service.studio.devices import Devices

        assert self.poses, "checked before"
        convention = self.pose_convention
        fixed_intrinsics = self.fixed_intrinsics
        wrist = None if self.camera is None else open_camera(self.camera)
        fixed = None if self.fixed is None else open_camera(self.fixed)
        intrinsics = self.intrinsics
        begun = self.out / "wrist" / "camera.json"
        if not intrinsics and self.camera is None:
            intrinsics = fixed_intrinsics
        elif not intrinsics and begun.is_file():
            intrinsics = begun
        camera = _intrinsics(intrinsics, wrist or fixed)
        if not camera:
            raise InputError(
                "no --intrinsics FILE given: a new recording needs the intrinsics"
            )
        reachable = None
        if self.reachable:
            poses = read_robot_poses(
                self.reachable, convention, option="--pose-convention"
            )
            reachable = poses.poses
        return Devices(
            wrist_camera=wrist,
            intrinsics=camera,
            robot=open_robot(self.poses, self.named.names(), convention, self.most_age),
            fixed_camera=fixed,
            fixed_intrinsics=_intrinsics(fixed_intrinsics, fixed),
            reachable=reachable,
            rough=args.transform_of(self.gripper_from_camera),
            live=all(map(is_live, filter(None, (self.camera, self.fixed)))),
        )


def _intrinsics(file: Path | None, camera: "StreamCamera | None") -> "Camera | None":
    return args.stated_camera(file) or (camera and camera.intrinsics())
