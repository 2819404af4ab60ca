"""`evercal watch`."""

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.check import Reference, shift_line
from evercal.cli.console import say
from evercal.errors import InputError
from evercal.reports.answers import shift_dict

if TYPE_CHECKING:
    import numpy as np


FALSE_ALARMS = 0.01
"""Probability of any false alarm while a folder is watched."""


@frozen
class Watch(args.Verb):
    """Watch a camera, or a folder of arriving images; stop with exit code 1 when it has moved.

    The newest images are tested together, so that a single outlier raises no alarm. With --json,
    every image gives one object.

    Example: evercal watch cell.evercal incoming/ --reference tripod.json
    """

    store: args.Store
    source: Annotated[Positional[str], arg(metavar="SOURCE")]
    """Folder that images arrive in, or a camera: ros2:/camera/image_raw, rtsp://..., 0."""
    reference: Reference
    window: args.Number = 5
    """Newest images that are tested together."""
    interval: Annotated[float, arg(metavar="SECONDS")] = 1.0
    """Interval between scans of the folder, or images of the camera."""
    idle: args.Seconds = None
    """Stop with exit code 0 after this time without a new image. Default: never."""
    scene: args.Scenes = ()
    camera: args.File = None
    """Intrinsics. Default: those of the reference."""

    def run(self) -> int:
        if self.window < 1 or self.interval <= 0:
            raise InputError("--window is at least 1 and --interval is above 0")
        from evercal.calibration.calibration import read_calibration
        from evercal.calibration.drift import shift_between
        from evercal.calibration.located import ImagePose, fuse, locate

        reference = read_calibration(self.reference)
        localizer = args.open_map(self.store, self.scene)
        recent: deque[ImagePose] = deque(maxlen=self.window)
        arrivals = arrivals_of(self.source)
        tests = 0
        last = time.monotonic()
        while self.idle is None or time.monotonic() - last < self.idle:
            for name, pixels in arrivals():
                height, width = pixels.shape[:2]
                camera = (
                    args.stated_camera(self.camera, (width, height)) or reference.camera
                )
                try:
                    recent.extend(locate(localizer, [(name, pixels)], camera))
                except InputError as error:
                    say(f"warning: {name}: {error}; skipped", sys.stderr)
                    continue
                last = time.monotonic()
                if not any(image.is_located for image in recent):
                    reason = recent[-1].estimate.reason
                    self._print(name, {"moved": None, "reason": reason}, reason)
                    continue
                tests += 1
                confidence = 1 - false_alarm_share(tests)
                shift = shift_between(
                    reference, fuse(recent), list(recent), localizer, confidence
                )
                self._print(name, shift_dict(shift), shift_line(shift))
                used = sum(image.used for image in shift.images)
                if shift.moved and used >= min(3, self.window):
                    return 1
            time.sleep(self.interval)
        return 0

    def _print(self, name: str, record: dict[str, object], line: str) -> None:
        now = datetime.now(UTC).strftime("%H:%M:%S")
        self.answer({"image": name, **record}, f"{now} {name}: {line}")


def arrivals_of(source: str) -> "Callable[[], Iterable[tuple[str, np.ndarray]]]":
    """What has arrived in a folder since the last call, or the newest image of a camera."""
    from evercal.live.sources import open_camera
    from evercal.recordings.streams import is_live

    if not is_live(source):
        if not Path(source).is_dir():
            raise InputError(
                f"{source}: no such folder; give the one that images arrive in, or a camera"
            )
        return Arrivals(Path(source)).scan
    camera = open_camera(source)

    def newest() -> "list[tuple[str, np.ndarray]]":
        stamp_s, image = camera.read()
        return [(f"{stamp_s:.3f}", image)]

    return newest


class Arrivals:
    """Images that arrive in a folder.

    Files that are still being written are read again after they have changed. A file that is not an
    image and no longer changes is reported once.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._done: set[Path] = set()
        self._broken: dict[Path, tuple[int, int]] = {}

    def scan(self) -> "Iterator[tuple[str, np.ndarray]]":
        """Name and pixels of every image that is new and complete, oldest first."""
        from evercal.recordings import read_image
        from evercal.recordings.images import files_in

        states: dict[Path, tuple[int, int]] = {}
        for path in files_in(self._folder):
            if path not in self._done:
                # Removed or renamed since it was listed.
                with suppress(FileNotFoundError):
                    status = path.stat()
                    states[path] = status.st_mtime_ns, status.st_size
        for path in sorted(states, key=lambda path: (states[path][0], path.name)):
            if self._broken.get(path) == states[path]:
                self._done.add(path)
                say(f"warning: {path}: not a readable image, skipped", sys.stderr)
                continue
            try:
                pixels = read_image(path)
            except InputError:
                self._broken[path] = states[path]
                continue
            self._done.add(path)
            yield path.name, pixels


def false_alarm_share(test: int) -> float:
    """Probability of a false alarm that the n-th test may have, n from 1.

    The sum over all tests is 1 %, however long the folder is watched and however windows overlap
    (Bonferroni with weights 6 / (pi n)^2).
    """
    return FALSE_ALARMS * 6 / (math.pi * test) ** 2
