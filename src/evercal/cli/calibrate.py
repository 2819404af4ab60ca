"""`evercal calibrate`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, progress_bar
from evercal.cli.device import Device
from evercal.cli.image_words import camera_for, image_files, read_images
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration
    from evercal.calibration.from_images import Images
    from evercal.calibration.rig import Rig
    from evercal.localization.localizer import Localizer


@dataclass(frozen=True)
class Calibrate:
    """Calibrate a camera from images of a scene that the store knows; no marker is needed.

    A camera that stands still gives base_from_camera. With --robot-poses, a camera on the gripper
    gives gripper_from_camera. NAME=FOLDER words, one for each camera, calibrate several cameras
    and their poses relative to each other.
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the store."""
    images: Annotated[Positional[tuple[str, ...]], arg(metavar="IMAGE...", help_behavior_hint="")]
    """Image files or folders of them, all of one camera; or NAME=FOLDER for each camera of a
    rig."""
    robot_poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """The gripper's pose in the base at every image, in the order of the images."""
    convention: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """How the numbers of the robot poses are meant, where the file does not say it."""
    mount: Literal["eye_to_hand", "eye_in_hand"] | None = None
    """Whether the camera stands still (eye_to_hand) or the gripper carries it (eye_in_hand); found
    out when left out."""
    camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """File of the intrinsics; those of the scene that is found when left out."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("calibration.json")
    """Where the calibration is written."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Calibrates, writes the file and says what it is good for."""
        named = {word.split("=", 1)[0]: Path(word.split("=", 1)[1]) for word in self._named()}
        from evercal.localization.localizer import Localizer

        if named:
            return self._rig(Localizer.open(self.store, device=self.device), named)
        files = image_files([Path(word) for word in self.images])
        given = self._given(files)
        localizer = Localizer.open(self.store, device=self.device)
        found = self._calibrated(localizer, given)
        found.write(self.out)
        if self.json:
            print_json(found.to_dict())
        else:
            for line in calibration_lines(found):
                print(line)
            print_next("evercal", "export", self.out, "--format", "easy_handeye2")
        from evercal.calibration.verdict import tier

        return 0 if tier(found) else 1

    def _named(self) -> list[str]:
        named = [word for word in self.images if "=" in word and not Path(word).exists()]
        if named and len(named) < len(self.images):
            raise InputError(
                f"{named[0]}: NAME=FOLDER words and plain images do not go together; give"
                " NAME=FOLDER for every camera of the rig"
            )
        if named and self.robot_poses is not None:
            raise InputError(
                "--robot-poses: the cameras of a rig stand still; leave the option out"
            )
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
            found = calibrate(localizer, given, self.mount, on_image=bar.update)
        return replace(found, source={**found.source, "store": str(self.store)})

    def _rig(self, localizer: "Localizer", folders: dict[str, Path]) -> int:
        from evercal.calibration.rig import rig_of

        cameras = {}
        for name, folder in folders.items():
            cameras[name] = self._calibrated(localizer, self._given(image_files([folder])))
        rig = rig_of(cameras)
        rig.write(self.out)
        if self.json:
            print_json(rig.to_dict())
        else:
            for line in _rig_lines(rig):
                print(line)
        return 0


def calibration_lines(found: "Calibration") -> list[str]:
    """A calibration for people."""
    used = sum(image.used for image in found.images)
    x, y, z = 1000 * found.parent_from_child.translation_m
    lines = [
        f"{found.parent_frame}_from_{found.child_frame}: the {found.meaning}",
        f"  translation  {x:+.2f} {y:+.2f} {z:+.2f} mm",
        "  quaternion   "
        + " ".join(f"{value:+.6f}" for value in found.parent_from_child.rotation_wxyz)
        + " wxyz",
        f"  uncertainty  {found.sigma_mm:.2f} mm, {found.sigma_deg:.3f} deg (standard deviation per"
        " axis)",
    ]
    lines += [
        f"    of it      {term.translation_mm:.2f} mm, {term.rotation_deg:.3f} deg: {term.name}"
        for term in found.error_terms
    ]
    if "repeatability_mm" in found.checks:
        checks = found.checks
        lines.append(
            f"  two halves   of the images differ by {checks['repeatability_mm']:.2f} mm and"
            f" {checks['repeatability_deg']:.3f} deg"
        )
    if found.images:
        lines.append(f"  images       {used} of {len(found.images)} used")
    lines += [f"    left out   {i.name}: {i.reason}" for i in found.images if not i.used]
    return [*lines, f"  verdict      {found.verdict}"]


def _rig_lines(rig: "Rig") -> list[str]:
    lines = []
    for name, found in rig.cameras.items():
        first, *rest = calibration_lines(found)
        lines += [f"{name}: {first}", *rest]
    for pair in rig.relative:
        x, y, z = 1000 * pair.first_from_second.translation_m
        lines.append(
            f"{pair.first}_from_{pair.second}: {x:+.2f} {y:+.2f} {z:+.2f} mm, standard deviation"
            f" {pair.sigma_mm:.2f} mm and {pair.sigma_deg:.3f} deg"
        )
    return lines
