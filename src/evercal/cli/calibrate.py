"""`evercal calibrate`."""

import itertools
import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from evercal.choices import MountName
from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import motion, numbers, require_writable, say_notes
from evercal.errors import InputError
from evercal.progress import progress_bar

if TYPE_CHECKING:
    from evercal.calibration.calibration import (
        Calibration,
        ImageUse,
        JointOffset,
        Rig,
    )
    from evercal.calibration.image_source import Images
    from evercal.localization.localizer import Localizer

_GROUP = 3
"""Number of rejected images that are one group, if they disagree alike."""
_ALIKE = 0.2
"""Largest difference of their distances, relative to the median."""


@frozen
class Calibrate(args.Verb):
    """Calibrate a camera from images of a mapped scene; no marker is needed.

    A fixed camera gives base_from_camera. With --robot-poses, a camera on the gripper gives
    gripper_from_camera. NAME=FOLDER, once for each camera, calibrates several cameras and their
    poses relative to each other.

    Example: evercal calibrate cell.evercal tripod/ --camera camera.json --out tripod.json
    """

    writes = ("out",)
    store: args.Store
    images: Annotated[Positional[tuple[str, ...]], args.shown("IMAGE...")]
    """Image files or folders of them, all of one camera; or NAME=FOLDER for each camera of a
    rig."""
    robot_poses: args.File = None
    """base_from_gripper of every image: a pose table, JSON, NPY or NPZ. Those of a rig before a
    thing in the gripper are found by the names of the images, which may repeat between folders."""
    convention: args.Name = None
    """Format of the robot poses, if the file does not state it."""
    mount: Annotated[MountName | None, args.shown("eye_to_hand|eye_in_hand")] = None
    """eye_to_hand for a fixed camera, eye_in_hand for one on the gripper. Default: decided from
    the camera's motion."""
    scene: args.Scenes = ()
    camera: args.File = None
    """Intrinsics of these images. Default: those of the camera that recorded the scene."""
    frames: args.HowNamed = field(default_factory=args.Named)
    out: args.OutFile = Path("calibration.json")
    """Output file."""
    at: args.At = None

    def run(self) -> int:
        require_writable(self.out, "--out")
        point = args.Point.parse(self.at)
        folders = self._folders()
        from evercal.recordings.image_files import image_files

        if folders:
            return self._rig(folders, point)
        images = self._taken(image_files(self.images))
        calibration = self._calibrated(
            args.open_map(self.store, self.scene), images, self.mount
        )
        calibration.write(self.out)
        return show_calibration(self, calibration, self.out, point)

    def _folders(self) -> dict[str, Path]:
        """The folder of each camera of a rig; empty for one camera."""
        folders = {}
        named = []
        for word in self.images:
            name, sign, path = word.partition("=")
            if sign and "/" not in name and not Path(word).exists():
                named.append(word)
                folders[name] = Path(path)
        if named and len(named) < len(self.images):
            raise InputError(
                f"{named[0]}: NAME=FOLDER and plain images cannot be mixed; give NAME=FOLDER for"
                " every camera of the rig"
            )
        if named and self.frames.camera_frame:
            raise InputError(
                "--camera-frame: is of one camera; give --child to the export of each"
            )
        if named and self.mount == "eye_in_hand":
            raise InputError("--mount: the cameras of a rig are fixed; omit the option")
        return folders

    def _taken(self, files: list[Path]) -> "Images":
        from evercal.calibration.image_source import Images

        camera = args.camera_for(self.camera, files)
        images = Images.of(
            files, camera, self.robot_poses, self.convention, self.frames.names()
        )
        say_notes(images.notes)
        return images

    def _calibrated(
        self, localizer: "Localizer", images: "Images", mount: MountName | None
    ) -> "Calibration":
        from evercal.calibration.from_images import calibrate

        with progress_bar("localizing", len(images.images), "image") as bar:
            calibration = calibrate(localizer, images, mount, on_image=bar.update)
        source = {**calibration.source, "store": str(self.store)}
        return replace(calibration, source=source)

    def _rig(self, folders: dict[str, Path], point: args.Point | None) -> int:
        from evercal.calibration.calibration import rig_of
        from evercal.recordings.image_files import image_files

        localizer = args.open_map(self.store, self.scene)
        cameras = {}
        for name, folder in folders.items():
            images = self._taken(image_files([folder]))
            cameras[name] = self._calibrated(localizer, images, "eye_to_hand")
        rig = rig_of(cameras)
        rig.write(self.out)
        record = rig.to_dict()
        for name, calibration in rig.cameras.items():
            record["cameras"][name] |= at_record(calibration, point)
        self.answer(record, *rig_lines(rig, point))
        return 0


def at_record(
    calibration: "Calibration", point: args.Point | None
) -> dict[str, object]:
    """The entry of --at in the JSON answer; empty without a point."""
    if not point:
        return {}
    return {"at": point.record(calibration.uncertain_pose)}


def show_calibration(
    verb: args.Verb,
    calibration: "Calibration",
    out: Path,
    point: args.Point | None = None,
    lines: Iterable[str] = (),
) -> int:
    """Print a calibration that was written to a file, and further lines; the exit code."""
    from evercal.calibration.verdict import tier

    verb.answer(
        {**calibration.to_dict(), **at_record(calibration, point)},
        *calibration_lines(calibration, point),
        *lines,
        then=args.next_words(calibration, out),
    )
    return 0 if tier(calibration) else 1


def calibration_lines(
    calibration: "Calibration", point: args.Point | None = None
) -> Iterator[str]:
    """A calibration in lines. `point` is that of --at."""
    from evercal.calibration.calibration import position_shares

    pose = calibration.parent_from_child
    scene = ""
    if "scene" in calibration.source:
        scene = f"; scene {calibration.source['scene']}"
    frames = f"{calibration.parent_frame}_from_{calibration.child_frame}"
    yield f"{frames}: the {calibration.meaning}{scene}"
    yield f"  translation  {numbers(1000 * pose.translation_m, '+.2f')} mm"
    yield f"  quaternion   {numbers(pose.rotation_wxyz, '+.6f')} wxyz"
    spread = motion(calibration.sigma_mm, calibration.sigma_deg)
    yield f"  uncertainty  {spread} (standard deviation per axis)"
    terms = calibration.error_terms
    for term, share in zip(terms, position_shares(terms), strict=True):
        if term.translation_mm >= 0.005 or term.rotation_deg >= 0.0005:
            size = motion(term.translation_mm, term.rotation_deg)
            part = f"{100 * share:.0f} % of the position's variance"
            yield f"    of it      {size}: {term.name} ({part})"
    yield from lens_lines(calibration)
    if point:
        yield f"  point        {point.text(calibration.uncertain_pose)}"
    yield from held_out_lines(calibration)
    checks = calibration.checks
    if checks.repeatability_mm is not None:
        apart = motion(checks.repeatability_mm, checks.repeatability_deg, " and ")
        yield f"  two halves   of the images differ by {apart}"
    images = calibration.images
    rejected = [image for image in images if not image.used]
    if images:
        yield f"  images       {len(images) - len(rejected)} of {len(images)} used"
    yield from _rejected_lines(rejected)
    yield f"  verdict      {calibration.verdict}"


def _rejected_lines(rejected: "Sequence[ImageUse]") -> Iterator[str]:
    """Images that disagree alike are one group."""
    sizes = [image.residual_mm or 0.0 for image in rejected]
    middle = statistics.median([size for size in sizes if size] or [0.0])
    alike = [abs(size - middle) < _ALIKE * middle for size in sizes]
    if sum(alike) < _GROUP:
        alike = [False] * len(sizes)
    group = list(itertools.compress(rejected, alike))
    if group:
        yield (
            f"    rejected   {len(group)} images, {group[0].name} to {group[-1].name}: each"
            f" disagrees with the others by about {middle:.1f} mm, as after one motion"
        )
    for image, known in zip(rejected, alike, strict=True):
        if not known:
            yield f"    rejected   {image.name}: {image.reason}"


def held_out_lines(calibration: "Calibration") -> Iterator[str]:
    """How well each gripper pose is predicted by the others."""
    checks = calibration.checks
    if checks.held_out_mm is None:
        return
    error = motion(checks.held_out_mm, checks.held_out_deg, " and ")
    if checks.held_out_sigmas is not None:
        error += f", {checks.held_out_sigmas:.1f} of their standard deviations"
    yield f"  left out     half of the poses are predicted within {error}"


def lens_lines(calibration: "Calibration") -> Iterator[str]:
    """What the pose is for, where the estimated intrinsics are not the stated ones."""
    if calibration.lens == "estimated" and "stated" in calibration.lenses:
        left = calibration.stated_left_rad
        yield (
            "  intrinsics   the pose is for the estimated ones; 'evercal export' turns it for the"
            f" stated ones, with a residual of {math.degrees(left):.3f} deg,"
            f" {500 * left:.2f} mm at 0.5 m"
        )


def joint_lines(joints: Sequence["JointOffset"], file: object) -> Iterator[str]:
    """The offsets of an arm's joints in lines; `file` holds the calibration."""
    corrected = False
    bounds = []
    for joint in joints:
        unit, times = joint.unit
        offset = times * joint.offset
        sigma = times * joint.sigma
        if joint.open:
            continue
        if abs(joint.offset) >= 2 * joint.sigma:
            corrected = True
            yield f"joint {joint.name}: add {offset:+.2f} {unit} (standard deviation {sigma:.2f})"
        bounds.append(f"{abs(offset) + 2 * sigma:.2f} {unit} ({joint.name})")
    if corrected:
        words = (
            f"export {file} --format corrected_urdf --urdf ROBOT.urdf --out NEW.urdf"
        )
        yield f"joints: the camera is that of the corrected arm; correct its URDF: evercal {words}"
    elif bounds:
        yield f"joints: no offset above {', '.join(bounds)}"
    for joint in joints:
        if joint.open:
            yield f"joint {joint.name}: not determined; {joint.open}"


def rig_lines(rig: "Rig", point: args.Point | None = None) -> Iterator[str]:
    """Several cameras in lines."""
    for name, calibration in rig.cameras.items():
        first, *others = calibration_lines(calibration, point)
        yield f"{name}: {first}"
        yield from others
    for first, second, pose, moments in rig.relative:
        position = numbers(1000 * pose.pose.translation_m, "+.2f")
        spread = motion(pose.sigma_mm, pose.sigma_deg, " and ")
        how = "standard deviation at most {} (independent errors assumed)"
        if moments is not None:
            how = f"standard deviation {{}}, {moments} moments in common"
        yield f"{first}_from_{second}: {position} mm, {how.format(spread)}"
