"""The results of `evercal demo` and their HTML report."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from statistics import median

from evercal.classes import frozen
from evercal.evaluation import FrameResult, scores
from evercal.reports.page import Picture, Table, Tile, render
from evercal.typing import JsonObject


@frozen
class LearnedRoom:
    """The map of one room."""

    room: str
    images: int
    """Posed training images."""
    keyframes: int
    """Images in the map."""
    landmarks: int
    residual_px: float | None
    """Median reprojection error after bundle adjustment."""
    seconds: float


@frozen
class FixedCamera:
    """The calibration of a fixed camera and the check after a bump, compared with ground truth."""

    room: str
    images: int
    images_used: int = 0
    """Images in the calibration; 0 if it failed."""
    error_mm: float | None = None
    """Position error of the calibration; None if it failed."""
    error_deg: float | None = None
    sigma_mm: float | None = None
    """Stated standard deviation of the position per axis; None if it failed."""
    shift_mm: float | None = None
    """Measured shift after the bump; None if no image was localized."""
    true_shift_mm: float = 0.0
    bump_detected: bool = False
    """Whether the check reported a moved camera."""


@dataclass
class DemoResult:
    """All measurements of a demo."""

    learned: list[LearnedRoom] = field(default_factory=list)
    memory_bytes: int = 0
    """Size of all maps."""
    test: list[FrameResult] = field(default_factory=list)
    """Test images of all rooms."""
    changed: list[FrameResult] = field(default_factory=list)
    """Images taken after objects were moved and lamps were switched."""
    cameras: list[FixedCamera] = field(default_factory=list)
    unknown_images: int = 0
    """Images of rooms that had not been learned yet."""
    unknown_refused: int = 0
    """How many of them got no pose."""
    seconds: float = 0.0

    def headlines(self) -> dict[str, str]:
        """Explanation of each main result, most important first."""
        position = _median(1000 * row.translation_error_m for row in self.test)
        radians = median(row.rotation_error_rad for row in self.test)
        degrees = math.degrees(radians)
        fixed = _median(camera.error_mm for camera in self.cameras)
        shift = _median(camera.shift_mm for camera in self.cameras)
        true_shift = _median(camera.true_shift_mm for camera in self.cameras)
        detected = sum(camera.bump_detected for camera in self.cameras)
        bumps = f"{detected} of {len(self.cameras)} bumps"
        refused = f"{self.unknown_refused} of {self.unknown_images}"
        return {
            position: f"median position error of one image, {degrees:.3f} deg in rotation",
            fixed: "median position error of a fixed camera after calibration",
            bumps: f"detected: {shift} measured, {true_shift} true (medians)",
            refused: "images of unknown rooms refused",
        }

    def to_dict(self) -> JsonObject:
        """JSON values."""
        return {
            "rooms": [room.room for room in self.learned],
            "learned": [asdict(room) for room in self.learned],
            "memory_bytes": self.memory_bytes,
            "test": scores(self.test).to_dict(),
            "changed": scores(self.changed).to_dict(),
            "fixed_cameras": [asdict(camera) for camera in self.cameras],
            "unknown_room": {
                "images": self.unknown_images,
                "refused": self.unknown_refused,
            },
            "seconds": self.seconds,
        }


def demo_page(result: DemoResult, pictures: Sequence[Picture]) -> str:
    """Write the report of a demo."""
    (number, meaning), *others = result.headlines().items()
    return render(
        "demo.html",
        title="evercal demo",
        headline=f"{number} {meaning}",
        level="",
        first=[Tile(*item) for item in others],
        result=result,
        pictures=pictures,
        scores={"": scores(result.test), "after a change": scores(result.changed)},
        cameras=Table.of_records(result.cameras),
        maps=Table.of_records(result.learned),
    )


def _median(values: Iterable[float | None]) -> str:
    numbers = [value for value in values if value is not None]
    if not numbers:
        return "none"
    return f"{median(numbers):.2f} mm"
