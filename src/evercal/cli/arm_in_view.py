"""`evercal arm-in-view`."""

from dataclasses import field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.calibrate import joint_lines, show_calibration
from evercal.cli.console import require_writable, say_notes
from evercal.progress import Bars


@frozen
class ArmInView(args.Verb):
    """Calibrate a fixed camera by the robot arm in its images; no board, nothing in the gripper.

    The recording has images of the fixed camera and the joint values at each. The URDF with its
    meshes says what the arm looks like. 10 images and more, with the arm at places far apart.

    Example: evercal arm-in-view recording/ --urdf robot.urdf --out camera.json
    """

    writes = ("out", "report")
    recording: Annotated[Positional[Path], args.shown("RECORDING")]
    """Folder of images with joints.csv, or a bag with joint states."""
    out: args.OutFile = Path("calibration.json")
    """Output file."""
    report: args.File = None
    """Also write an HTML report: the outline of the arm drawn into the images, residuals."""
    without: Annotated[tuple[str, ...], args.shown("LINK...")] = ()
    """Links whose mesh is not what is mounted, such as another gripper."""
    reading: args.HowRead = field(default_factory=args.Reading)
    which: args.WhichArm = field(default_factory=args.ArmGiven)
    at: args.At = None

    def run(self) -> int:
        require_writable(self.out, "--out")
        require_writable(self.report, "--report")
        point = args.Point.parse(self.at)
        from evercal.calibration.arm_in_view.solve import calibrate_arm_in_view
        from evercal.recordings.formats.wrist import urdf_beside
        from evercal.robot.robot_model import RobotModel

        recording = self.reading.recording(self.recording, whole_robot=True)
        say_notes(recording.notes)
        model = RobotModel(self.reading.urdf or urdf_beside(self.recording))
        start = f"{recording.name}: {len(recording.train)} images"
        with Bars(self.log, start) as bars:
            calibration = calibrate_arm_in_view(
                recording,
                model,
                self.which.errors(),
                self.without,
                on_progress=bars.step,
            )
        lost = ", ".join(calibration.source["links_not_shown"])
        if lost:
            words = (
                f"the images do not show the outline of {lost}: another mesh or tool?"
            )
            say_notes([words])
        source = {**calibration.source, "without": self.without}
        calibration = replace(calibration, source=source)
        calibration.write(self.out)
        if self.report is not None:
            from evercal.reports.arm_pictures import arm_pictures
            from evercal.reports.calibration_page import (
                NamedCalibration,
                calibration_page,
            )
            from evercal.storage import write_bytes

            images = arm_pictures(calibration, recording, model, self.without)
            named = NamedCalibration(self.out.name, calibration)
            page = calibration_page(named, images, point_m=point)
            write_bytes(self.report, page.html.encode())
        lines = joint_lines(calibration.joints, self.out)
        return show_calibration(self, calibration, self.out, point, lines)
