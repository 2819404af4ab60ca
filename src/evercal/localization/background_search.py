"""Locating an image in another thread, while a stream goes on."""

from concurrent.futures import Future, ThreadPoolExecutor, wait

import numpy as np

from evercal.geometry import Camera
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.localization.query import Hypothesis

Located = tuple[PoseEstimate, Hypothesis]


class BackgroundSearch:
    """Locates one image at a time.

    Args:
        localizer: Localizer of the map.
        camera: Intrinsics. Default: those of the camera that recorded the scene.
    """

    def __init__(self, localizer: Localizer, camera: Camera | None):
        self._localizer, self._camera = localizer, camera
        self._pool = ThreadPoolExecutor(1, "search")
        self._running: tuple[float, Future[Located]] | None = None

    @property
    def under_way(self) -> bool:
        """Whether an image was given whose result was not taken."""
        return self._running is not None

    def start(self, image: np.ndarray, stamp_s: float) -> None:
        """Locate an image; the one before it must have been taken."""
        assert self._running is None, "one image at a time"
        future = self._pool.submit(self._localizer.located, image, self._camera)
        self._running = stamp_s, future

    def take(self, wait_s: float) -> tuple[float, Located] | None:
        """Time of the image and its result; None if it is not ready in time."""
        assert self._running is not None, "an image was given"
        stamp, future = self._running
        if not wait([future], max(wait_s, 0.0)).done:
            return None
        self._running = None
        return stamp, future.result()
