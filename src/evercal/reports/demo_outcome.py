"""What a demo leaves to be shown."""

import math
from dataclasses import asdict, dataclass, field

from evercal.evaluation.metrics import Scores

METHODS = {"evercal": "evercal", "finetune": "fine-tuning", "sars_spdd": "SARS + SPDD"}
"""Strategies and what pictures call them."""
MAP = "evercal"
"""The strategy whose store stays and is looked at closely."""
FIXED_HEADER = ("room", "images used", "error mm", "error deg")
BUMP_HEADER = ("room", "moved mm", "in truth mm", "turned deg", "in truth deg", "std. dev. mm")
LEARNED_HEADER = ("room", "images", "keyframes", "landmarks", "residual px", "seconds")


@dataclass(frozen=True)
class LearnedRoom:
    """What learning a room took and left."""

    room: str
    """Its name."""
    images: int
    """Posed training images."""
    keyframes: int
    """Of them stay in the map."""
    landmarks: int
    """Of all keyframes."""
    residual_px: float
    """Median reprojection error after bundle adjustment."""
    seconds: float
    """Wall time."""


@dataclass(frozen=True)
class FixedCamera:
    """Where a camera that stands still was found, against the truth."""

    room: str
    """Where it stands."""
    images: int
    """Of the camera, the arm elsewhere in each."""
    used: int
    """Images that the calibration rests on."""
    error_mm: float | None
    """Distance from the true position; None without an answer."""
    error_deg: float | None
    """Angle to the true orientation; None without an answer."""


@dataclass(frozen=True)
class Bump:
    """How far a fixed camera was found to have moved, against the truth."""

    room: str
    """Where it stands."""
    shift_mm: float
    """Distance between the camera before and after, as `check` found it."""
    shift_deg: float
    """Angle between them."""
    true_mm: float
    """By how much it moved."""
    true_deg: float
    """By how much it turned."""
    sigma_mm: float
    """Standard deviation of the shift per axis."""
    moved: bool
    """Whether `check` calls it a move."""


@dataclass(frozen=True)
class UnknownRoom:
    """Images of a room that was never learned."""

    images: int
    """How many were shown."""
    refused: int
    """How many were answered by `unknown_scene` or `failed`."""


@dataclass
class DemoOutcome:
    """What came out."""

    rooms: list[str]
    """In order of learning."""
    accuracy: dict[str, list[list[float]]] = field(default_factory=dict)
    """Per strategy that is compared: row i after stage i, column j room j; per cent within 5 cm
    and 5 deg."""
    minutes: dict[str, float] = field(default_factory=dict)
    """Per strategy: of learning all rooms."""
    learned: list[LearnedRoom] = field(default_factory=list)
    """How the map was made."""
    memory_bytes: int = 0
    """What the map keeps of all rooms."""
    test: Scores | None = None
    """Of the test images of all rooms, after the last room."""
    changed: Scores | None = None
    """Of images taken after things in the rooms were moved and lamps switched."""
    errors_m: dict[str, list[float]] = field(default_factory=dict)
    """Translation errors of the images of `test`, by room; infinite without a pose."""
    changed_errors_m: list[float] = field(default_factory=list)
    """The same of all images of `changed`."""
    fixed: list[FixedCamera] = field(default_factory=list)
    """A camera per room, located after the last room."""
    bumps: list[Bump] = field(default_factory=list)
    """The same cameras after a bump."""
    unknown: UnknownRoom | None = None
    """A room that was never learned."""
    seconds: float = 0.0
    """Of the whole demo."""

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {
            "rooms": self.rooms,
            "learned": [asdict(room) for room in self.learned],
            "memory_bytes": self.memory_bytes,
            "test": self.test.to_dict() if self.test else None,
            "changed": self.changed.to_dict() if self.changed else None,
            "fixed_cameras": [asdict(camera) for camera in self.fixed],
            "bumps": [asdict(bump) for bump in self.bumps],
            "unknown_room": asdict(self.unknown) if self.unknown else None,
            "accuracy_5cm_5deg": self.accuracy,
            "minutes": self.minutes,
            "seconds": self.seconds,
        }

    def learned_rows(self) -> list[list[str]]:
        """Cells under LEARNED_HEADER."""
        return [
            [
                room.room,
                str(room.images),
                str(room.keyframes),
                str(room.landmarks),
                f"{room.residual_px:.2f}",
                f"{room.seconds:.0f}",
            ]
            for room in self.learned
        ]

    def compared_header(self) -> list[str]:
        """Titles of `compared_rows`."""
        return ["method", "after", *(f"{room} %" for room in self.rooms), "minutes"]

    def compared_rows(self) -> list[list[str]]:
        """Method, stage, the accuracy on each room, and the minutes of all rooms."""
        rows = []
        for method, matrix in self.accuracy.items():
            for i, accuracies in enumerate(matrix):
                cells = [f"{value:.1f}" for value in accuracies]
                blanks = [""] * (len(self.rooms) - len(cells))
                last = i == len(matrix) - 1
                minutes = f"{self.minutes[method]:.1f}" if last else ""
                rows.append([METHODS[method], f"+ {self.rooms[i]}", *cells, *blanks, minutes])
        return rows

    def table(self) -> str:
        """The same for the terminal."""
        from tabulate import tabulate

        header = self.compared_header()
        align = ("left", "left", *("right" for _ in header[2:]))
        rows = self.compared_rows()
        text = tabulate(rows, headers=header, colalign=align, disable_numparse=True)
        return f"test images within 5 cm and 5 deg\n{text}"

    def fixed_rows(self) -> list[list[str]]:
        """Cells under FIXED_HEADER."""
        return [
            [
                camera.room,
                f"{camera.used} of {camera.images}",
                "" if camera.error_mm is None else f"{camera.error_mm:.2f}",
                "" if camera.error_deg is None else f"{camera.error_deg:.3f}",
            ]
            for camera in self.fixed
        ]

    def bump_rows(self) -> list[list[str]]:
        """Cells under BUMP_HEADER."""
        return [
            [
                bump.room,
                f"{bump.shift_mm:.2f}",
                f"{bump.true_mm:.2f}",
                f"{bump.shift_deg:.3f}",
                f"{bump.true_deg:.3f}",
                f"{bump.sigma_mm:.2f}",
            ]
            for bump in self.bumps
        ]


def located(errors_m: list[float]) -> int:
    """How many of the images have a pose in their own room."""
    return sum(math.isfinite(error) for error in errors_m)
