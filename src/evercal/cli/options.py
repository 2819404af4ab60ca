"""Arguments that several verbs share, and how a verb prints its result."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next

Store = Annotated[Positional[Path], arg(metavar="MAP", help="Folder of the map.")]
Images = Annotated[Positional[tuple[Path, ...]], arg(metavar="IMAGE...", help_behavior_hint="")]
SomeImages = Annotated[
    Positional[tuple[Path, ...]], arg(metavar="[IMAGE...]", help_behavior_hint="")
]
File = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")]
Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]
Name = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
Source = Annotated[str | None, arg(metavar="SOURCE", help_behavior_hint="")]
Frame = Annotated[str | None, arg(metavar="FRAME", help_behavior_hint="")]
Count = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
Intrinsics = Annotated[
    Path | None,
    arg(
        metavar="FILE",
        help_behavior_hint="",
        help="Intrinsics of the images: 3x3 matrix as text, JSON, YAML, NPZ, ROS camera_info or"
        " OpenCV's storage. Default: those of the camera that recorded the scene.",
    ),
]
At = Annotated[
    str | None,
    arg(
        metavar="X,Y,Z",
        help_behavior_hint="",
        help="A point in the camera frame (x right, y down, z forward; metres), such as an object"
        " that the camera sees: its standard deviation in the base or gripper frame is printed.",
    ),
]
Host = Annotated[str, arg(metavar="H", help="Address to listen on; 0.0.0.0 is all of them.")]
Port = Annotated[int, arg(metavar="P", help="Port to listen on; 0 for any free one.")]
Device = Annotated[
    Literal["auto", "cpu", "cuda"],
    arg(help="Device of the encoder and networks; auto uses a CUDA device if there is one."),
]


@dataclass(frozen=True, kw_only=True)
class Verb:
    """A verb with its arguments."""

    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Run and return the exit code."""
        raise NotImplementedError

    def answer(self, record: object, lines: Iterable[str] = (), then: Iterable[object] = ()) -> int:
        """Print the result and return exit code 0.

        Args:
            record: the result with --json.
            lines: the result without.
            then: the command to run next, without `evercal`; words in capitals are placeholders.
        """
        if self.json:
            print_json(record)
            return 0
        for line in lines:
            print(line, flush=True)
        if words := tuple(then):
            print_next("evercal", *words)
        return 0
