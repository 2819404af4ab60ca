"""`evercal calibrate`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from evercal.cli.arguments import (
    Point,
    camera_for,
    open_map,
    point_dict,
    point_of,
    point_text,
    read_images,
)
from evercal.cli.console import progress_bar, require_writable
from evercal.cli.options import At, Device, File, Intrinsics, Name, Store, Verb
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration, ErrorTerm, Rig
    from evercal.calibration.from_images import Images
    from evercal.localization.localizer import Localizer


@dataclass(frozen=True)
class Calibrate(Verb):
    """Calibrate a camera from images of a mapped scene; no marker is needed.

    A fixed camera gives base_from_camera. With --robot-poses, a camera on the gripper gives
    gripper_from_camera. NAME=FOLDER, once for each camera, calibrates several cameras and their
    poses relative to each other.

    Example: evercal calibrate cell.evercal tripod/ --camera camera.json --out tripod.json
    """

    store: Store
    images: Annotated[Positional[tuple[str, ...]], arg(metavar="IMAGE...", help_behavior_hint="")]
    """Image files or folders of them, all of one camera; or NAME=FOLDER for each camera of a
    rig."""
    robot_poses: File = None
    """base_from_gripper of every image: a pose table, JSON, NPY or NPZ."""
    convention: Name = None
    """Format of the robot poses, if the file does not state it."""
    mount: Annotated[
        Literal["eye_to_hand", "eye_in_hand"] | None,
        arg(metavar="eye_to_hand|eye_in_hand", help_behavior_hint=""),
    ] = None
    """eye_to_hand for a fixed camera, eye_in_hand for one on the gripper. Default: decided from
    the camera's motion."""
    camera: Intrinsics = None
    out: Annotated[Path, arg(metavar="FILE")] = Path("calibration.json")
    """Output file."""
    at: At = None
    device: Device = "auto"

    def run(self) -> int:
        require_writable(self.out, "--out")
        point = point_of(self.at)
        named = {word.split("=", 1)[0]: Path(word.split("=", 1)[1]) for word in self._named()}
        from evercal.recordings.image_files import image_files

        if named:
            return self._rig(open_map(self.store, self.device), named, point)
        files = image_files([Path(word) for word in self.images])
        given = self._given(files)
        localizer = open_map(self.store, self.device)
        calibration = self._calibrated(localizer, given)
        calibration.write(self.out)
        self.answer(
            {**calibration.to_dict(), **_at_dict(calibration, point)},
            calibration_lines(calibration, point),
            ("export", self.out, "--format", "easy_handeye2"),
        )
        from evercal.calibration.verdict import tier

        return 0 if tier(calibration) else 1

    def _named(self) -> list[str]:
        named = [word for word in self.images if "=" in word and not Path(word).exists()]
        if named and len(named) < len(self.images):
            raise InputError(
                f"{named[0]}: NAME=FOLDER and plain images cannot be mixed; give NAME=FOLDER for"
                " every camera of the rig"
            )
        if named and self.robot_poses is not None:
            raise InputError("--robot-poses: the cameras of a rig are fixed; omit the option")
        return named

    def _given(self, files: list[Path]) -> "Images":
        from evercal.calibration.from_images import Images

        poses = None
        if self.robot_poses is not None:
            from evercal.recordings.poses.pairing import poses_of_images

            poses = poses_of_images(self.robot_poses, files, self.convention)
        return Images(read_images(files), camera_for(self.camera, files), poses)

    def _calibrated(self, localizer: "Localizer", given: "Images") -> "Calibration":
        from evercal.calibration.from_images import calibrate

        with progress_bar("localizing", len(given.images), "image") as bar:
            calibration = calibrate(localizer, given, self.mount, on_image=bar.update)
        return replace(calibration, source={**calibration.source, "store": str(self.store)})

    def _rig(self, localizer: "Localizer", folders: dict[str, Path], point: Point | None) -> int:
        from evercal.calibration.calibration import rig_of
        from evercal.recordings.image_files import image_files

        cameras = {}
        for name, folder in folders.items():
            cameras[name] = self._calibrated(localizer, self._given(image_files([folder])))
        rig = rig_of(cameras)
        rig.write(self.out)
        record = rig.to_dict()
        for name, calibration in rig.cameras.items():
            record["cameras"][name] |= _at_dict(calibration, point)
        return self.answer(record, _rig_lines(rig, point))


def _at_dict(calibration: "Calibration", point: Point | None) -> dict[str, object]:
    return {} if point is None else {"at": point_dict(point, calibration.uncertain_pose)}


def calibration_lines(calibration: "Calibration", point: Point | None = None) -> list[str]:
    """A calibration in lines. `point` is that of --at."""
    used = sum(image.used for image in calibration.images)
    x, y, z = 1000 * calibration.parent_from_child.translation_m
    lines = [
        f"{calibration.parent_frame}_from_{calibration.child_frame}: the {calibration.meaning}",
        f"  translation  {x:+.2f} {y:+.2f} {z:+.2f} mm",
        "  quaternion   "
        + " ".join(f"{value:+.6f}" for value in calibration.parent_from_child.rotation_wxyz)
        + " wxyz",
        f"  uncertainty  {calibration.sigma_mm:.2f} mm, {calibration.sigma_deg:.3f} deg"
        " (standard deviation per axis)",
    ]
    lines += _budget_lines(calibration.error_terms)
    if point is not None:
        lines.append(f"  point        {point_text(point, calibration.uncertain_pose)}")
    if "repeatability_mm" in calibration.checks:
        checks = calibration.checks
        lines.append(
            f"  two halves   of the images differ by {checks['repeatability_mm']:.2f} mm and"
            f" {checks['repeatability_deg']:.3f} deg"
        )
    if calibration.images:
        lines.append(f"  images       {used} of {len(calibration.images)} used")
    lines += [f"    rejected   {i.name}: {i.reason}" for i in calibration.images if not i.used]
    return [*lines, f"  verdict      {calibration.verdict}"]


def _budget_lines(terms: "Sequence[ErrorTerm]") -> list[str]:
    from evercal.calibration.calibration import position_shares

    return [
        f"    of it      {term.translation_mm:.2f} mm, {term.rotation_deg:.3f} deg:"
        f" {term.name} ({100 * share:.0f} % of the position's variance)"
        for term, share in zip(terms, position_shares(terms), strict=True)
        if term.translation_mm >= 0.005 or term.rotation_deg >= 0.0005
    ]


def _rig_lines(rig: "Rig", point: Point | None) -> list[str]:
    lines = []
    for name, calibration in rig.cameras.items():
        first, *rest = calibration_lines(calibration, point)
        lines += [f"{name}: {first}", *rest]
    for pair in rig.relative:
        pose = pair.first_from_second
        x, y, z = 1000 * pose.pose.translation_m
        lines.append(
            f"{pair.first}_from_{pair.second}: {x:+.2f} {y:+.2f} {z:+.2f} mm, standard deviation"
            f" at most {pose.sigma_mm:.2f} mm and {pose.sigma_deg:.3f} deg (independent errors"
            " assumed)"
        )
    return lines
