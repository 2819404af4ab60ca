"""The fixed camera: its images, its calibration, and whether it has moved since."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from evercal.calibration.calibration import Calibration
from evercal.calibration.drift import Shift
from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.live.recorder import JPEG_QUALITY
from evercal.map import Map
from evercal.recordings.images import write_jpeg
from evercal.recordings.poses.camera_file import read_camera
from evercal.service.studio.devices import Image
from evercal.service.studio.folders import Folders
from evercal.storage import write_json


class FixedCamera:
    """Images and calibration of the fixed camera.

    Args:
        folders: where they are; those of an earlier session are continued.
        camera: its intrinsics; None for those of the camera that recorded the scene.
    """

    def __init__(self, folders: Folders, camera: Camera | None):
        self._folders = folders
        if camera is not None:
            write_json(folders.fixed_camera, asdict(camera))
        # Those of an earlier session hold until others are given.
        self._camera = read_camera(folders.fixed_camera) if self._has_camera else None

    @property
    def _has_camera(self) -> bool:
        return self._folders.fixed_camera.is_file()

    @property
    def files(self) -> list[Path]:
        """Its images, in order."""
        return sorted(self._folders.fixed.glob("*.jpg"))

    def add(self, image: Image) -> Path:
        """Write an image."""
        self._folders.fixed.mkdir(parents=True, exist_ok=True)
        number = max((int(path.stem) for path in self.files), default=-1) + 1
        path = self._folders.fixed / f"{number:04d}.jpg"
        write_jpeg(path, image, JPEG_QUALITY)
        return path

    def clear(self) -> None:
        """Remove all images, such as after the camera was moved."""
        for path in self.files:
            path.unlink()

    def calibrate(self, cell: Map, on_image: Callable[[], Any] = lambda: None) -> Calibration:
        """Calibrate from all images and write the file.

        Raises:
            InputError: No image was taken, or none was located.
        """
        if not self.files:
            raise InputError("no image of the fixed camera yet; take one first")
        found = cell.calibrate(
            self.files, camera=self._camera, mount="eye_to_hand", on_image=on_image
        )
        found = replace(found, source={**found.source, "store": str(cell.path)})
        found.write(self._folders.calibration("fixed"))
        return found

    def check(self, cell: Map, image: Image, reference: Calibration) -> Shift:
        """Test whether the camera has moved since its calibration.

        Raises:
            InputError: The image was not located.
        """
        path = self._folders.out / "check.jpg"
        write_jpeg(path, image, JPEG_QUALITY)
        return cell.check([path], reference)


def shift_words(shift: Shift) -> str:
    """The answer of a check in one line."""
    size = f"{shift.translation_mm:.2f} mm and {shift.rotation_deg:.3f} deg"
    if shift.moved:
        sure = f"{100 * shift.confidence:.1f} %"
        return f"The camera has moved by {size} (confidence {sure}). Calibrate it again."
    return f"The camera has not moved: it is within {size} of its calibration."


def option_of_studio(verdict: str | None) -> str | None:
    """A verdict that names the option of the studio instead of that of `evercal calibrate`."""
    return verdict and verdict.replace("--camera", "--fixed-intrinsics")
