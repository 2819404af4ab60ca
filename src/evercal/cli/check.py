"""`evercal check`."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import motion
from evercal.errors import InputError
from evercal.progress import progress_bar
from evercal.reports.answers import check_record, shift_dict

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration
    from evercal.calibration.drift import Shift

Reference = Annotated[
    Path, arg(metavar="FILE", help="The camera's calibration from 'evercal calibrate'.")
]

_SCATTER = 2.0
"""Outlines scatter by this many times as much before a wrong URDF."""


@frozen
class Check(args.Verb):
    """Test whether a fixed camera has moved since it was calibrated; exit code 1 if it has.

    A reference with joint offsets and a new recording of the arm, with joint values: test which
    joints have changed. The recording is learned apart; the map stays as it is.

    A recording in place of the map: by the robot arm in its images, three or more with joint
    values. Without a map, any calibration of a fixed camera is tested so.

    Example: evercal check cell.evercal now.png --reference tripod.json

    Example: evercal check new/ --reference camera.json --urdf robot.urdf
    """

    store: Annotated[Positional[Path], args.shown("MAP|RECORDING")]
    """Folder of the map, or a recording of the arm in view."""
    images: args.ImageFiles
    """New images of one camera, or a folder of them; five or more reveal smaller shifts. Of an arm,
    a recording."""
    reference: Reference
    robot_poses: args.File = None
    """base_from_gripper of every image, where the scene is a thing in the gripper."""
    convention: args.Name = None
    """Format of the robot poses, if the file does not state it."""
    scene: args.Scenes = ()
    camera: args.File = None
    """Intrinsics. Default: those of the reference, or of the recording."""
    urdf: args.File = None
    """URDF of the arm, for recordings without one. Before a fixed camera it asks for a check of the
    arm that holds the thing."""
    gripper_frame: args.Frame = None
    """Link of the URDF that is the gripper. Default: its only end."""

    def run(self) -> int:
        from evercal.calibration.calibration import read_calibration
        from evercal.calibration.drift import check
        from evercal.calibration.image_source import Images
        from evercal.recordings.image_files import image_files

        reference = read_calibration(self.reference)
        if not self.images:
            if args.strategy_of(self.store) or self.robot_poses or self.scene:
                raise InputError(
                    f"{self.store}: give images that show a scene of a map, too, or a recording of"
                    " the arm with joint values and no poses"
                )
            return self._check_by_arm(reference)
        on_arm = reference.on_gripper and reference.joints
        if on_arm or self.urdf is not None or self.gripper_frame is not None:
            return self._check_arm(reference)
        files = image_files(self.images)
        camera = args.camera_for(self.camera, files)
        given = Images.of(files, camera, self.robot_poses, self.convention)
        localizer = args.open_map(self.store, self.scene)
        with progress_bar("localizing", len(given.images), "image") as bar:
            shift = check(
                localizer,
                given.images,
                reference,
                camera,
                bar.update,
                given.base_from_gripper,
            )
        lines = [shift_line(shift)]
        if shift.note:
            lines.append(shift.note)
        for image in shift.images:
            if not image.used:
                lines.append(f"  rejected  {image.name}: {image.reason}")
        then = ("calibrate", self.store, *self.images[:1]) if shift.moved else ()
        self.answer(check_record(shift), *lines, then=then)
        return 1 if shift.moved else 0

    def _check_arm(self, reference: "Calibration") -> int:
        from evercal.map import Map

        if len(self.images) != 1 or self.robot_poses is not None:
            raise InputError(
                "to check an arm, give one recording with joint values and no poses"
            )
        recording = self._reading().recording(self.images[0])
        with TemporaryDirectory() as folder:
            new = Map.open(Path(folder) / "map")
            learn = new.learn if reference.on_gripper else new.eye_to_hand
            learn(recording)
            now = new.calibration()
        return self._compared(reference, now)

    def _reading(self) -> args.Reading:
        return args.Reading(
            camera=self.camera,
            gripper_frame=self.gripper_frame,
            urdf=self.urdf,
            pose_convention=self.convention,
        )

    def _check_by_arm(self, reference: "Calibration") -> int:
        from evercal.calibration.arm_in_view.again import calibrated_again
        from evercal.recordings.formats.wrist import urdf_beside
        from evercal.robot.robot_model import RobotModel

        reading = replace(self._reading(), base_frame=reference.frames.base or None)
        recording = reading.recording(self.store, whole_robot=True)
        model = RobotModel(self.urdf or urdf_beside(self.store))
        return self._compared(reference, calibrated_again(recording, model, reference))

    def _compared(self, reference: "Calibration", now: "Calibration") -> int:
        from evercal.calibration.arm_change import arm_change
        from evercal.calibration.drift import shift_of

        change = "No joint has changed."
        try:
            confidence, changed, joints = arm_change(reference, now)
        except InputError as error:
            if self.images:
                raise
            confidence, changed, joints = 0.0, [], []
            change = f"Joints are not compared: {error}."
        shift = shift_of(
            reference, now.parent_from_child, reference.covariance + now.covariance
        )
        if changed:
            names = ", ".join(changed)
            change = f"Changed joints: {names} (confidence {100 * confidence:.1f} %)."
        lines = [change, shift_line(shift)]
        for joint in joints:
            unit, size = joint.unit
            sigma = joint.open or f"standard deviation {size * joint.sigma:.3f} {unit}"
            lines.append(f"  {joint.name}  {size * joint.offset:+.3f} {unit}: {sigma}")
        record = {
            "confidence": confidence,
            "changed": changed,
            "joints": [*map(vars, joints)],
        }
        lines += map("warning: {}".format, now.checks.warnings or ())
        px = now.checks.outline_sigma_px or 0
        before = reference.checks.outline_sigma_px or px
        if px > _SCATTER * before:
            lines.append(
                f"warning: outlines scatter by {px:.2f} px, {before:.2f} px in the reference: is"
                " this the URDF of the arm as it is now, and the lens the same?"
            )
        self.answer({**record, "camera": shift_dict(shift)}, *lines)
        return 1 if changed or shift.moved else 0


def shift_line(shift: "Shift") -> str:
    """The answer in one sentence."""
    size = motion(shift.translation_mm, shift.rotation_deg, " and ")
    sigma = motion(shift.sigma_mm, shift.sigma_deg, " and ")
    spread = f"standard deviation {sigma} per axis"
    confidence = f"confidence {100 * shift.confidence:.1f} %"
    if shift.moved:
        return f"The camera has moved by {size} ({confidence}; {spread}). Calibrate it again."
    return f"The camera has not moved: it is within {size} of its reference ({spread})."
