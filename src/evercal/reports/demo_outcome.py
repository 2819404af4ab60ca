"""What a demo leaves to be shown."""

from dataclasses import asdict, dataclass, field

METHODS = {"evercal": "evercal", "finetune": "fine-tuning"}
"""Strategies and what pictures call them."""
FIXED_HEADER = ["room", "images located", "error mm", "error deg"]


@dataclass(frozen=True)
class FixedCamera:
    """Where a camera that stands still was found, against the truth."""

    room: str
    """Where it stands."""
    images: int
    """Of the camera, the arm elsewhere in each."""
    located: int
    """Images that gave a pose in this room; their robust mean is the answer."""
    error_mm: float | None
    """Distance from the true position; None without an answer."""
    error_deg: float | None
    """Angle to the true orientation; None without an answer."""


@dataclass
class DemoOutcome:
    """What came out."""

    rooms: list[str]
    """In order of learning."""
    accuracy: dict[str, list[list[float]]] = field(default_factory=dict)
    """Per strategy: row i after stage i, column j room j; per cent within 5 cm and 5 deg."""
    seconds: dict[str, list[float]] = field(default_factory=dict)
    """Per strategy: of learning each room."""
    memory_bytes: int = 0
    """What `evercal` remembers of all rooms."""
    fixed: list[FixedCamera] = field(default_factory=list)
    """A camera per room, located by `evercal` after the last room."""

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON; row i of an accuracy has the i rooms learned so far."""
        return {
            "rooms": self.rooms,
            "accuracy_5cm_5deg": self.accuracy,
            "seconds": self.seconds,
            "memory_bytes": self.memory_bytes,
            "fixed_cameras": [asdict(camera) for camera in self.fixed],
        }

    def rows(self) -> list[list[str]]:
        """Method, stage, and the accuracy on each room."""
        rows = []
        for method, matrix in self.accuracy.items():
            for i, accuracies in enumerate(matrix):
                cells = [f"{value:.1f}" for value in accuracies]
                blanks = [""] * (len(self.rooms) - len(cells))
                rows.append([METHODS[method], f"+ {self.rooms[i]}", *cells, *blanks])
        return rows

    def table(self) -> str:
        """The same for the terminal."""
        from tabulate import tabulate

        header = ["method", "after", *(f"{room} %" for room in self.rooms)]
        align = ("left", "left", *("right" for _ in self.rooms))
        text = tabulate(self.rows(), headers=header, colalign=align, disable_numparse=True)
        return f"test frames within 5 cm and 5 deg\n{text}"

    def fixed_rows(self) -> list[list[str]]:
        """Room, images located, errors."""
        return [
            [
                camera.room,
                f"{camera.located} of {camera.images}",
                "" if camera.error_mm is None else f"{camera.error_mm:.1f}",
                "" if camera.error_deg is None else f"{camera.error_deg:.2f}",
            ]
            for camera in self.fixed
        ]

    def fixed_table(self) -> str:
        """The same for the terminal."""
        from tabulate import tabulate

        text = tabulate(self.fixed_rows(), headers=FIXED_HEADER, disable_numparse=True)
        return f"base_from_camera of a camera that stands still, against the truth\n{text}"
