"""`evercal watch`."""

import math
import time
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.check import shift_dict, shift_line
from evercal.cli.console import print_json
from evercal.cli.device import Device
from evercal.cli.image_words import camera_for
from evercal.cli.stores import open_map
from evercal.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from evercal.geometry import Camera

FALSE_ALARMS = 0.01
"""Probability of any false alarm while a folder is watched."""


@dataclass(frozen=True)
class Watch:
    """Watch a folder that a camera writes images to; stop with exit code 1 when it has moved.

    The newest images are tested together, so that a single outlier raises no alarm.

    Example: evercal watch cell.evercal incoming/ --reference tripod.json
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the map."""
    folder: Annotated[Positional[Path], arg(metavar="DIR")]
    """Folder that images arrive in."""
    reference: Annotated[Path, arg(metavar="FILE")]
    """The camera's calibration from 'evercal calibrate'."""
    window: Annotated[int, arg(metavar="N")] = 5
    """Newest images that are tested together."""
    interval: Annotated[float, arg(metavar="SECONDS")] = 1.0
    """Interval between scans of the folder."""
    idle: Annotated[float | None, arg(metavar="SECONDS")] = None
    """Stop with exit code 0 after this time without a new image. Default: never."""
    camera: Annotated[Path | None, arg(metavar="FILE")] = None
    """Intrinsics. Default: those of the reference."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object for every image."""

    def run(self) -> int:
        """Check new images until the camera has moved."""
        if not self.folder.is_dir():
            raise InputError(f"{self.folder}: no such folder; give the one that images arrive in")
        if self.window < 1 or self.interval <= 0:
            raise InputError("--window is at least 1 and --interval is above 0")
        from evercal.calibration.calibration import read_calibration
        from evercal.calibration.drift import shift_between
        from evercal.calibration.located import Located, fuse, locate

        reference = read_calibration(self.reference)
        localizer = open_map(self.store, self.device)
        recent: deque[Located] = deque(maxlen=self.window)
        done: set[Path] = set()
        tests, last = 0, time.monotonic()
        while self.idle is None or time.monotonic() - last < self.idle:
            for path in self._new(done):
                image = self._read(path, reference.camera)
                if image is None:
                    continue  # still being written: it is read again
                done.add(path)
                last = time.monotonic()
                recent.extend(locate(localizer, [(path.name, image.pixels)], image.camera))
                if not any(item.is_located for item in recent):
                    self._print(path, {"moved": None, "reason": recent[-1].estimate.reason})
                    continue
                tests += 1
                confidence = 1 - false_alarm_share(tests)
                shift = shift_between(reference, fuse(recent), list(recent), localizer, confidence)
                self._print(path, shift_dict(shift), shift_line(shift))
                if shift.moved and len(recent) >= min(3, self.window):
                    return 1
            time.sleep(self.interval)
        return 0

    def _read(self, path: Path, camera: "Camera | None") -> "_Image | None":
        """An image with its intrinsics; None if the file is incomplete or broken."""
        from evercal.recordings import read_image

        try:
            given = camera_for(self.camera, [path])
            return _Image(read_image(path), given or camera)
        except (InputError, OSError):
            if self.camera is not None and not self.camera.is_file():
                raise
            return None

    def _new(self, done: set[Path]) -> list[Path]:
        """Images that were not checked yet, oldest first."""
        from evercal.recordings.images import IMAGE_ENDINGS

        paths = [
            path
            for path in self.folder.iterdir()
            if path.suffix.lower() in IMAGE_ENDINGS and path not in done
        ]
        return sorted(paths, key=lambda path: (path.stat().st_mtime, path.name))

    def _print(self, path: Path, record: dict[str, object], line: str = "") -> None:
        if self.json:
            print_json({"image": path.name, **record})
            return
        now = datetime.now(UTC).strftime("%H:%M:%S")
        print(f"{now} {path.name}: {line or record['reason']}", flush=True)


@dataclass(frozen=True, eq=False)
class _Image:
    """An image that arrived."""

    pixels: "np.ndarray"
    camera: "Camera | None"


def false_alarm_share(test: int) -> float:
    """Probability of a false alarm that the n-th test may have, n from 1.

    The sum over all tests is 1 %, however long the folder is watched and however windows overlap
    (Bonferroni with weights 6 / (pi n)^2).
    """
    return FALSE_ALARMS * 6 / (math.pi * test) ** 2
