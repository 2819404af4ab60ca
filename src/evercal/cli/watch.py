"""`evercal watch`."""

import time
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.cli.check import shift_dict, shift_line
from evercal.cli.console import print_json
from evercal.cli.device import Device
from evercal.cli.image_words import camera_for
from evercal.errors import InputError


@dataclass(frozen=True)
class Watch:
    """Watch a folder that a camera writes images to, and stop with exit code 1 when it has moved.

    The newest images are checked together, so that one strange image raises no alarm.
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the store."""
    folder: Annotated[Positional[Path], arg(metavar="DIR")]
    """Folder that images arrive in."""
    reference: Annotated[Path, arg(metavar="FILE")]
    """The camera's calibration, as 'evercal calibrate' wrote it."""
    window: Annotated[int, arg(metavar="N")] = 5
    """How many of the newest images are checked together."""
    interval: Annotated[float, arg(metavar="SECONDS")] = 1.0
    """How often the folder is looked at."""
    idle: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")] = None
    """Stop with exit code 0 when no image has come for so long; never when left out."""
    camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """File of the intrinsics; those in the reference when left out."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object for every image."""

    def run(self) -> int:
        """Looks at the folder until the camera has moved."""
        if not self.folder.is_dir():
            raise InputError(f"{self.folder}: no such folder; give the one that images arrive in")
        if self.window < 1 or self.interval <= 0:
            raise InputError("--window is at least 1 and --interval is above 0")
        from evercal.calibration.calibration import read_calibration
        from evercal.calibration.drift import shift_between
        from evercal.calibration.located import Located, fuse, locate
        from evercal.localization.localizer import Localizer
        from evercal.recordings import read_image

        reference = read_calibration(self.reference)
        localizer = Localizer.open(self.store, device=self.device)
        recent: deque[Located] = deque(maxlen=self.window)
        seen: set[Path] = set()
        last = time.monotonic()
        while self.idle is None or time.monotonic() - last < self.idle:
            for path in self._new(seen):
                last = time.monotonic()
                lens = camera_for(self.camera, [path]) or reference.camera
                try:
                    image = read_image(path)
                except InputError:
                    continue  # still being written: it is looked at again
                seen.add(path)
                recent.extend(locate(localizer, [(path.name, image)], lens))
                if not any(item.found for item in recent):
                    self._tell(path, {"moved": None, "reason": recent[-1].estimate.reason})
                    continue
                shift = shift_between(reference, fuse(recent), list(recent), localizer)
                self._tell(path, shift_dict(shift), shift_line(shift))
                if shift.moved and len(recent) >= min(3, self.window):
                    return 1
            time.sleep(self.interval)
        return 0

    def _new(self, seen: set[Path]) -> list[Path]:
        """Images that were not looked at yet, oldest first."""
        from evercal.recordings.images import IMAGE_ENDINGS

        found = [
            path
            for path in self.folder.iterdir()
            if path.suffix.lower() in IMAGE_ENDINGS and path not in seen
        ]
        return sorted(found, key=lambda path: (path.stat().st_mtime, path.name))

    def _tell(self, path: Path, record: dict[str, object], line: str = "") -> None:
        if self.json:
            print_json({"image": path.name, **record})
            return
        now = datetime.now(UTC).strftime("%H:%M:%S")
        print(f"{now} {path.name}: {line or record['reason']}", flush=True)
