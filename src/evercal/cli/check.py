"""`evercal check`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, progress_bar
from evercal.cli.device import Device
from evercal.cli.image_words import camera_for, image_files, read_images

if TYPE_CHECKING:
    from evercal.calibration.drift import Shift


@dataclass(frozen=True)
class Check:
    """Say whether a camera has been moved since it was calibrated; exit code 1 when it has."""

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the store."""
    images: Annotated[Positional[tuple[Path, ...]], arg(metavar="IMAGE...", help_behavior_hint="")]
    """New images of one camera, or a folder of them; five or more see smaller shifts than one."""
    reference: Annotated[Path, arg(metavar="FILE")]
    """The camera's calibration, as 'evercal calibrate' wrote it."""
    camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """File of the intrinsics; those in the reference when left out."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Compares; says the shift and how sure it is."""
        from evercal.calibration.calibration import read_calibration
        from evercal.calibration.drift import check
        from evercal.localization.localizer import Localizer

        files = image_files(self.images)
        reference = read_calibration(self.reference)
        lens = camera_for(self.camera, files) or reference.camera
        images = read_images(files)
        localizer = Localizer.open(self.store, device=self.device)
        with progress_bar("localizing", len(images), "image") as bar:
            shift, uses = check(localizer, images, reference, lens, on_image=bar.update)
        if self.json:
            left_out = [vars(use) for use in uses if not use.used]
            print_json({**shift_dict(shift), "images": len(uses), "left_out": left_out})
        else:
            print(shift_line(shift))
            for use in uses:
                if not use.used:
                    print(f"  left out  {use.name}: {use.reason}")
            if shift.moved:
                print_next("evercal", "calibrate", self.store, *self.images[:1])
        return 1 if shift.moved else 0


def shift_line(shift: "Shift") -> str:
    """The answer in one sentence."""
    size = f"{shift.translation_mm:.2f} mm and {shift.rotation_deg:.3f} deg"
    spread = f"standard deviation {shift.sigma_mm:.2f} mm and {shift.sigma_deg:.3f} deg per axis"
    sure = f"confidence {100 * shift.confidence:.1f} %"
    if shift.moved:
        return f"The camera has moved by {size} ({sure}; {spread}). Calibrate it again."
    return f"The camera has not moved: it was found {size} from its reference ({spread})."


def shift_dict(shift: "Shift") -> dict[str, object]:
    """The answer as JSON values."""
    return {
        "moved": shift.moved,
        "translation_mm": shift.translation_mm,
        "rotation_deg": shift.rotation_deg,
        "sigma_mm": shift.sigma_mm,
        "sigma_deg": shift.sigma_deg,
        "confidence": shift.confidence,
        "same_map": shift.same_map,
        "reference_from_now": shift.reference_from_now.matrix().tolist(),
    }
