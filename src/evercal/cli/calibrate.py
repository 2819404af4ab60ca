"""`evercal calibrate`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional

from evercal.cli import args
from evercal.cli.console import require_writable, say_notes
from evercal.errors import InputError
from evercal.progress import progress_bar

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration, JointOffset, Rig
    from evercal.calibration.from_images import Images
    from evercal.localization.localizer import Localizer

Mount = Literal["eye_to_hand", "eye_in_hand"]


@dataclass(frozen=True)
class Calibrate(args.Verb):
    """Calibrate a camera from images of a mapped scene; no marker is needed.

    A fixed camera gives base_from_camera. With --robot-poses, a camera on the gripper gives
    gripper_from_camera. NAME=FOLDER, once for each camera, calibrates several cameras and their
    poses relative to each other.

    Example: evercal calibrate cell.evercal tripod/ --camera camera.json --out tripod.json
    """

    store: args.Store
    images: Annotated[Positional[tuple[str, ...]], args.shown("IMAGE...")]
    """Image files or folders of them, all of one camera; or NAME=FOLDER for each camera of a
    rig."""
    robot_poses: args.File = None
    """base_from_gripper of every image: a pose table, JSON, NPY or NPZ. Those of a rig before a
    thing in the gripper are found by the names of the images, which may repeat between folders."""
    convention: args.Name = None
    """Format of the robot poses, if the file does not state it."""
    mount: Annotated[Mount | None, args.shown("eye_to_hand|eye_in_hand")] = None
    """eye_to_hand for a fixed camera, eye_in_hand for one on the gripper. Default: decided from
    the camera's motion."""
    camera: args.File = None
    """Intrinsics of these images. Default: those of the camera that recorded the scene."""
    out: args.OutFile = Path("calibration.json")
    """Output file."""
    at: args.At = None

    def run(self) -> int:
        require_writable(self.out, "--out")
        point = args.Point.parse(self.at)
        folders = self._folders()
        from evercal.calibration.verdict import tier
        from evercal.recordings.image_files import image_files

        if folders:
            return self._rig(folders, point)
        given = self._given(image_files(self.images))
        calibration = self._calibrated(args.open_map(self.store), given, self.mount)
        calibration.write(self.out)
        self.answer(
            {**calibration.to_dict(), **at_record(calibration, point)},
            *calibration_lines(calibration, point),
            then=("export", self.out, "--format", "easy_handeye2"),
        )
        return 0 if tier(calibration) else 1

    def _folders(self) -> dict[str, Path]:
        """The folder of each camera of a rig; empty for one camera."""
        named = [
            word for word in self.images if "=" in word and not Path(word).exists()
        ]
        if named and len(named) < len(self.images):
            raise InputError(
                f"{named[0]}: NAME=FOLDER and plain images cannot be mixed; give NAME=FOLDER for"
                " every camera of the rig"
            )
        if named and self.mount == "eye_in_hand":
            raise InputError("--mount: the cameras of a rig are fixed; omit the option")
        return {
            name: Path(path)
            for name, _, path in (word.partition("=") for word in named)
        }

    def _given(self, files: list[Path]) -> "Images":
        from evercal.calibration.from_images import Images

        camera = args.camera_for(self.camera, files)
        given = Images.of(files, camera, self.robot_poses, self.convention)
        say_notes(given.notes)
        return given

    def _calibrated(
        self, localizer: "Localizer", given: "Images", mount: Mount | None
    ) -> "Calibration":
        from evercal.calibration.from_images import calibrate

        with progress_bar("localizing", len(given.images), "image") as bar:
            calibration = calibrate(localizer, given, mount, on_image=bar.update)
        return replace(
            calibration, source={**calibration.source, "store": str(self.store)}
        )

    def _rig(self, folders: dict[str, Path], point: args.Point | None) -> int:
        from evercal.calibration.calibration import rig_of
        from evercal.recordings.image_files import image_files

        localizer = args.open_map(self.store)
        cameras = {
            name: self._calibrated(
                localizer, self._given(image_files([folder])), "eye_to_hand"
            )
            for name, folder in folders.items()
        }
        rig = rig_of(cameras)
        rig.write(self.out)
        record = rig.to_dict()
        for name, calibration in rig.cameras.items():
            record["cameras"][name] |= at_record(calibration, point)
        self.answer(record, *_rig_lines(rig, point))
        return 0


def at_record(
    calibration: "Calibration", point: args.Point | None
) -> dict[str, object]:
    """The entry of --at in the JSON answer; empty without a point."""
    return {} if point is None else {"at": point.record(calibration.uncertain_pose)}


def calibration_lines(
    calibration: "Calibration", point: args.Point | None = None
) -> Iterator[str]:
    """A calibration in lines. `point` is that of --at."""
    from evercal.calibration.calibration import position_shares

    x, y, z = 1000 * calibration.parent_from_child.translation_m
    quaternion = " ".join(
        f"{q:+.6f}" for q in calibration.parent_from_child.rotation_wxyz
    )
    yield f"{calibration.parent_frame}_from_{calibration.child_frame}: the {calibration.meaning}"
    yield f"  translation  {x:+.2f} {y:+.2f} {z:+.2f} mm"
    yield f"  quaternion   {quaternion} wxyz"
    spread = f"{calibration.sigma_mm:.2f} mm, {calibration.sigma_deg:.3f} deg"
    yield f"  uncertainty  {spread} (standard deviation per axis)"
    terms = calibration.error_terms
    for term, share in zip(terms, position_shares(terms), strict=True):
        if term.translation_mm >= 0.005 or term.rotation_deg >= 0.0005:
            part = f"{term.translation_mm:.2f} mm, {term.rotation_deg:.3f} deg: {term.name}"
            yield f"    of it      {part} ({100 * share:.0f} % of the position's variance)"
    if point is not None:
        yield f"  point        {point.text(calibration.uncertain_pose)}"
    if "repeatability_mm" in (checks := calibration.checks):
        mm = checks["repeatability_mm"]
        deg = checks["repeatability_deg"]
        yield f"  two halves   of the images differ by {mm:.2f} mm and {deg:.3f} deg"
    if calibration.images:
        used = sum(image.used for image in calibration.images)
        yield f"  images       {used} of {len(calibration.images)} used"
    yield from (
        f"    rejected   {i.name}: {i.reason}" for i in calibration.images if not i.used
    )
    yield f"  verdict      {calibration.verdict}"


def joint_lines(joints: Sequence["JointOffset"], file: object) -> Iterator[str]:
    """The offsets of an arm's joints in lines; `file` holds the calibration."""
    rows = [(joint, *joint.unit) for joint in joints if not joint.open]
    large = [row for row in rows if abs(row[0].offset) >= 2 * row[0].sigma]
    for joint, unit, times in large:
        offset = times * joint.offset
        sigma = times * joint.sigma
        yield f"joint {joint.name}: add {offset:+.2f} {unit} (standard deviation {sigma:.2f})"
    if large:
        words = (
            f"export {file} --format corrected_urdf --urdf ROBOT.urdf --out NEW.urdf"
        )
        yield f"joints: the camera is that of the corrected arm; correct its URDF: evercal {words}"
    elif rows:
        most = [
            (times * (abs(j.offset) + 2 * j.sigma), unit, j.name)
            for j, unit, times in rows
        ]
        bounds = ", ".join(f"{value:.2f} {unit} ({name})" for value, unit, name in most)
        yield f"joints: no offset above {bounds}"
    yield from (f"joint {j.name}: not determined; {j.open}" for j in joints if j.open)


def _rig_lines(rig: "Rig", point: args.Point | None) -> Iterator[str]:
    for name, calibration in rig.cameras.items():
        first, *rest = calibration_lines(calibration, point)
        yield from (f"{name}: {first}", *rest)
    for first, second, pose in rig.relative:
        x, y, z = 1000 * pose.pose.translation_m
        yield (
            f"{first}_from_{second}: {x:+.2f} {y:+.2f} {z:+.2f} mm, standard deviation at most"
            f" {pose.sigma_mm:.2f} mm and {pose.sigma_deg:.3f} deg (independent errors assumed)"
        )
