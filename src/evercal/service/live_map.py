"""`LiveMap`: a map that answers while other processes change it."""

import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evercal.errors import InputError
from evercal.map import Map
from evercal.reports.answers import Answer, answer_row, unit_known
from evercal.storage.manifest import MANIFEST

if TYPE_CHECKING:
    import numpy as np

    from evercal.geometry import Camera


class LiveMap:
    """The last complete state of a map on disk.

    A request takes `current` once and answers from it, so that no answer mixes two states.

    Args:
        path: Folder of the map; it may be missing until a first scene is learned.
        device: `auto`, `cpu` or `cuda`.

    Raises:
        InputError: The folder holds something else, or a file is missing or was changed.
    """

    def __init__(self, path: Path, device: str = "auto"):
        self._path, self._device, self._lock = path, device, threading.Lock()
        self._stamp: tuple[int, ...] | None = None
        self._last_image: np.ndarray | None = None
        self.current = self._opened()

    @property
    def path(self) -> Path:
        """Folder of the map."""
        return self._path

    def refresh(self) -> bool:
        """Open the map again if another process has changed it; True if it has.

        A map that cannot be read is logged, and the last state stays.
        """
        with self._lock:
            if _stamp(self._path) == self._stamp:
                return False
            try:
                self.current = self._opened()
            except Exception as error:
                if not isinstance(error, InputError):  # perhaps for a moment only: try again
                    self._stamp = None
                logging.getLogger(__name__).warning("%s; the last state is served", error)
            return True

    def _opened(self) -> Map:
        # Read first: a change while the map is opened is then noticed the next time.
        self._stamp = _stamp(self._path)
        opened = Map.open(self._path, device=self._device)
        if opened.scenes:
            localizer = opened.localizer
            if self._last_image is not None:  # encode keyframes before requests wait for it
                localizer.localize(self._last_image)
        return opened

    def row(
        self, read: "Callable[[], tuple[np.ndarray, Camera | None]]", name: str
    ) -> dict[str, Any]:
        """The row of `evercal localize --json` for one image; the time includes reading it.

        `read` gives the image and its intrinsics, if they are stated.

        Raises:
            InputError: What `read` raises, a camera that does not fit the image, or a map without
                scenes.
        """
        localizer, began = self.current.localizer, time.perf_counter()
        image, camera = read()
        estimate = localizer.localize(image, camera)
        milliseconds = 1000 * (time.perf_counter() - began)
        if estimate.status == "ok":
            self._last_image = image
        known = unit_known(localizer, estimate.scene)
        return answer_row(Answer(Path(name), estimate, milliseconds, known))


def _stamp(path: Path) -> tuple[int, ...] | None:
    """Identify a state of a map: its manifest is replaced by every change."""
    try:
        status = os.stat(path / MANIFEST)
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size
