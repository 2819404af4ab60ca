"""`evercal check`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from evercal.cli import args
from evercal.progress import progress_bar
from evercal.reports.answers import check_record

if TYPE_CHECKING:
    from evercal.calibration.drift import Shift

Reference = Annotated[
    Path, arg(metavar="FILE", help="The camera's calibration from 'evercal calibrate'.")
]


@dataclass(frozen=True)
class Check(args.Verb):
    """Test whether a fixed camera has moved since it was calibrated; exit code 1 if it has.

    Example: evercal check cell.evercal now.png --reference tripod.json
    """

    store: args.Store
    images: args.ImageFiles
    """New images of one camera, or a folder of them; five or more reveal smaller shifts."""
    reference: Reference
    robot_poses: args.File = None
    """base_from_gripper of every image, where the scene is a thing in the gripper."""
    convention: args.Name = None
    """Format of the robot poses, if the file does not state it."""
    camera: args.File = None
    """Intrinsics. Default: those of the reference."""

    def run(self) -> int:
        from evercal.calibration.calibration import read_calibration
        from evercal.calibration.drift import check
        from evercal.calibration.from_images import Images
        from evercal.recordings.image_files import image_files

        files = image_files(self.images)
        reference = read_calibration(self.reference)
        camera = args.camera_for(self.camera, files)
        given = Images.of(files, camera, self.robot_poses, self.convention)
        images, poses = given.images, given.base_from_gripper
        localizer = args.open_map(self.store)
        with progress_bar("localizing", len(images), "image") as bar:
            shift = check(localizer, images, reference, camera, bar.update, poses)
        rejected = [use for use in shift.images if not use.used]
        self.answer(
            check_record(shift),
            shift_line(shift),
            *([shift.note] if shift.note else []),
            *(f"  rejected  {use.name}: {use.reason}" for use in rejected),
            then=("calibrate", self.store, *self.images[:1]) if shift.moved else (),
        )
        return 1 if shift.moved else 0


def shift_line(shift: "Shift") -> str:
    """The answer in one sentence."""
    size = f"{shift.translation_mm:.2f} mm and {shift.rotation_deg:.3f} deg"
    spread = f"standard deviation {shift.sigma_mm:.2f} mm and {shift.sigma_deg:.3f} deg per axis"
    confidence = f"confidence {100 * shift.confidence:.1f} %"
    if shift.moved:
        return f"The camera has moved by {size} ({confidence}; {spread}). Calibrate it again."
    return f"The camera has not moved: it is within {size} of its reference ({spread})."
