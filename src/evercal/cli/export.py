"""`evercal export`."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from evercal.choices import Motors
from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import say
from evercal.errors import InputError, printable

if TYPE_CHECKING:
    from evercal.calibration.export.formats import Exported
    from evercal.calibration.export.request import Export as Request


@frozen
class Export(args.Verb):
    """Write a calibration in the format of another program; `--format list` lists all formats.

    Without `--out` the text is printed. The pose is parent_from_child: the camera in the robot base
    for a fixed camera (eye_to_hand), in the gripper for a camera on the arm (eye_in_hand).

    Example: evercal export tripod.json --format urdf --out camera.urdf
    """

    calibration: Annotated[
        Positional[Path | None], args.shown("[CALIBRATION.json]")
    ] = None
    """Calibration file, or a map that was learned from gripper poses (MAP or MAP:SCENE)."""
    format: args.Name = None
    """Format, such as easy_handeye2, urdf, opencv or kuka; `list` lists all."""
    out: args.File = None
    """File to write; a new folder for colmap."""
    lens: Annotated[str | None, args.shown("stated|estimated|FILE")] = None
    """Intrinsics of the program that takes the pose: those stated with the images, the estimated
    ones, which are then written beside it, or a camera file. Default: the stated ones, if any."""
    parent: args.Frame = None
    """New name of the parent frame: the robot base or the gripper."""
    child: args.Frame = None
    """New name of the child frame: the camera's optical frame."""
    via: args.Frame = None
    """Export this root frame of the camera driver, such as camera_link."""
    via_transform: args.File = None
    """With --via: output of `ros2 topic echo --once /tf_static`, or a TransformStamped."""
    via_offset: Annotated[tuple[float, float, float] | None, args.shown("X Y Z")] = None
    """With --via: offset of the optical frame (forward, left, up), metres."""
    via_optical: bool = False
    """With --via: both frames have the same origin."""
    robot_frame: args.Frame = None
    """For easy_handeye: new name of the gripper frame of a fixed camera, else of the base frame."""
    robot_poses: args.File = None
    """Gripper pose of every image: moveit_samples, or tum, colmap, nerfstudio on the arm."""
    target_poses: args.File = None
    """Board pose in the camera for every image, for moveit_samples."""
    convention: args.Name = None
    """Pose convention of --robot-poses if its header does not state it: ur, kuka, fanuc, ..."""
    urdf: args.File = None
    """For corrected_urdf: URDF of the arm that was recorded."""
    lerobot_calibration: args.File = None
    """For lerobot: the calibration file of the arm."""
    publish: bool = False
    """Publish it in ROS 2 until Ctrl-C: latched on /tf_static, and a PoseWithCovarianceStamped."""
    lerobot_motors: Annotated[Motors | None, args.shown("feetech|dynamixel")] = None
    """For lerobot: feetech (SO-100, SO-101) or dynamixel (Koch, OMX)."""

    def run(self) -> int:
        from evercal.calibration.export.formats import FORMATS, export_files
        from evercal.calibration.export.request import ExportOptions, prepare_export
        from evercal.calibration.learned import calibration_at

        if self.format == "list" or (self.format is None and not self.calibration):
            file = self.calibration or "CALIBRATION.json"
            formats = {name: row.description for name, row in FORMATS.items()}
            self.answer(
                {"formats": formats},
                *map("{:27} {}".format, formats, formats.values()),
                then=("export", file, "--format", "NAME"),
            )
            return 0
        if self.format is None and not self.publish:
            raise InputError(
                f"no format given; add --format NAME, one of {', '.join(FORMATS)}, or --publish"
            )
        if not self.calibration:
            raise InputError("no calibration given; name its JSON file after 'export'")
        options = {key: getattr(self, key) for key in ExportOptions.__annotations__}
        calibration = calibration_at(self.calibration)
        if self.format is None:
            self._publish(prepare_export(calibration, **options))
            return 0
        exported = export_files(calibration, self.format, self.out, **options)
        self._show(exported, calibration.verdict)
        return 0

    def _publish(self, export: "Request") -> None:
        from evercal.calibration.export.request import require_names
        from evercal.live.ros2.publishing import PosePublisher

        calibration = export.calibration
        require_names(calibration, both=False)
        publisher = PosePublisher(export.parent, export.child, static=True)
        publisher.publish(calibration.uncertain_pose, time.time())
        where = " and ".join(publisher.topics)
        record = {"topics": publisher.topics}
        self.wait(record, f"published on {where}", f"  {calibration.meaning}")

    def _show(self, exported: "Exported", verdict: str) -> None:
        calibration = exported.calibration
        child = calibration.child_frame
        pose = calibration.parent_from_child
        files = list(map(str, exported.files))
        if exported.format.frame == "tf" and self.via is None and "optical" in child:
            say(
                f"note: most camera drivers publish {child} themselves; if yours does, give its"
                f" root frame with --via, because a tf frame has only one parent",
                sys.stderr,
            )
        for note in exported.notes:
            say(f"note: {note}", sys.stderr)
        if calibration.lens:
            say(f"note: the pose is for {calibration.lens_in_words}", sys.stderr)
        if not self.out and not self.json:
            sys.stdout.write(printable(exported.text))
            return
        record = {
            "format": self.format,
            "mount": calibration.mount,
            "parent_frame": calibration.parent_frame,
            "child_frame": child,
            "meaning": calibration.meaning,
            "translation_m": pose.translation_m.tolist(),
            "quaternion_wxyz": pose.rotation_wxyz.tolist(),
            "lens": calibration.lens,
            "camera": calibration.camera and calibration.camera.to_dict(),
            "verdict": verdict,
            "notes": exported.notes,
            "files": files,
            "text": None if files else exported.text,
        }
        lines = [f"wrote {', '.join(files)}", f"  {calibration.meaning}"]
        if verdict:
            lines.append(f"  {verdict}")
        then = ("check", "MAP", "IMAGE", "--reference", self.calibration)
        self.answer(record, *lines, then=then)
