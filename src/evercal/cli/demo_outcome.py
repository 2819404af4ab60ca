"""What a demo leaves to be shown."""

from dataclasses import dataclass, field

METHODS = {"evercal": "evercal", "finetune": "fine-tuning"}
"""Strategies and what pictures call them."""


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

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON; row i of an accuracy has the i rooms learned so far."""
        return {
            "rooms": self.rooms,
            "accuracy_5cm_5deg": self.accuracy,
            "seconds": self.seconds,
            "memory_bytes": self.memory_bytes,
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
